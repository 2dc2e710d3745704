"""Fusion: the scores of several methods as one, without labels.

Label maps, features and pictures err at different places. The scores of each method for a query
become z-scores over all references. The weight of a method is its trust, how much it counts before
anything is known of a traverse, times the lead of its first candidates there. The trust of each
channel was chosen as docs/fusion.md says. Not in the paper.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from ..native.decide import Scores
from .comparison import Comparison
from .motion import ELSEWHERE, MIN_SPREAD, ROUNDING
from .standardise import MIN_FRAMES

_SAMPLE, _IN_MEMORY = 200, 1 << 26
"""Queries that show the lead of a method, and scores that are in memory at once."""


class FusedScores(Scores):
    """The scores of one traverse of queries by several methods as one, computed on demand.

    They have the form of cosines, for `recognise_by_scores`. Where a method has no
    score of a pair, the others decide. Queries fewer than `standardise.MIN_FRAMES` do not show
    which method leads, so trust alone weighs them.

    Args:
        members: by the name of each method ``(Q, R)`` float scores, at most 1, higher for what is
            more alike; -inf where there can be no match.
        trust: of methods by their names; others count 1.

    Attributes:
        weights: by the names of the methods; their sum is 1.

    Raises:
        ValueError: there is no method, or the shapes differ.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch.recognition.fusion import FusedScores
        >>> here, there = torch.eye(20), torch.eye(20).roll(1, 0)
        >>> fused = FusedScores({"hog": here, "ssr-vlad": there}, {"hog": 2})
        >>> fused.whole().argmax(1).equal(torch.arange(20))
        True
    """

    def __init__(
        self, members: Mapping[str, Scores], trust: Mapping[str, float] | None = None
    ) -> None:
        shapes = {(len(m), *m[0].shape) if len(m) else (0,) for m in members.values()}
        if len(shapes) != 1 or len(next(iter(shapes))) != 2:
            got = ", ".join(map(str, shapes)) or "none"
            raise ValueError(f"expected scores (Q, R) of one shape, got {got}")
        self._members = list(members.values())
        leads = dict.fromkeys(members, 0.0)
        if len(self) >= MIN_FRAMES:
            sample = range(0, len(self), max(1, len(self) // _SAMPLE))
            for name, scores in members.items():
                leads[name] = sum(z_lead(scores[query]) for query in sample) / len(sample)
        self.weights = weights_of(leads, trust or {})

    def __len__(self) -> int:
        return len(self._members[0])

    def __getitem__(self, query: int, /) -> Tensor:
        return fused([each[query] for each in self._members], [*self.weights.values()])

    def whole(self) -> Tensor:
        """``(Q, R)`` float32."""
        return torch.stack([self[query] for query in range(len(self))])


def fused_scores(
    comparisons: Mapping[str, Comparison], trust: Mapping[str, float]
) -> tuple[Scores | Tensor, dict[str, float]]:
    """The scores of all channels as one, in memory if they fit, and the weights of several
    channels."""
    every: Scores
    if len(comparisons) == 1:
        [every], weights = comparisons.values(), dict[str, float]()
    else:
        every = FusedScores(comparisons, trust)
        weights = every.weights
    if not len(every) or len(every) * len(every[0]) > _IN_MEMORY:
        return every, weights
    return torch.stack([every[query] for query in range(len(every))]), weights


def weights_of(leads: Mapping[str, float], trusted: Mapping[str, float]) -> dict[str, float]:
    """The weights of methods by their names, the leads of their first candidates and their trust,
    which is 1 where none is given; their sum is 1. Where no method leads, trust decides."""
    trust = {name: trusted.get(name, 1.0) for name in leads}
    known = {name: trust[name] * max(0.0, lead) for name, lead in leads.items()}
    weights = known if sum(known.values()) > 0 else trust
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def nearness(scores: Tensor) -> Tensor:
    """Minus the logarithm of half the squared Euclidean distance of descriptors of length 1."""
    return (1 - scores).clamp_(min=ROUNDING).log_().neg_()


def lead(near: Tensor) -> Tensor:
    """``(Q,)``, how much nearer the first candidate is than the best row `ELSEWHERE`; infinite if
    no row is elsewhere. ``near`` ``(Q, N)`` is the nearness of all rows of the map."""
    rows = torch.arange(near.shape[1])
    apart = (rows - rows[near.argmax(1)][:, None]).abs()
    return near.amax(1) - near.masked_fill(apart <= ELSEWHERE, -torch.inf).amax(1)


def moments(scores: Tensor) -> tuple[float, float]:
    """Mean and standard deviation of the nearness of scores, without scores of -inf."""
    return _moments(nearness(scores))


def _moments(near: Tensor) -> tuple[float, float]:
    if not len(near):
        return 0.0, MIN_SPREAD
    least, most = map(float, near.aminmax())
    if least == -torch.inf:
        return _moments(near[near > -torch.inf])
    if most - least <= MIN_SPREAD:
        return least, MIN_SPREAD
    mean = float(near.mean())
    deviation = math.sqrt(float((near - mean).square_().mean()))
    return mean, max(MIN_SPREAD, deviation)


def z_lead(scores: Tensor) -> float:
    """The lead of the first candidate of a query, see `lead`, in standard deviations of the
    nearness of its scores ``(R,)``; 0 if there are too few scores."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    return float(lead(Scale.of(scores).z(scores)[None]))


class Scale(NamedTuple):
    """Mean and standard deviation ``(..., 1)`` of the nearness of scores ``(..., R)`` that are not
    -inf."""

    mean: Tensor
    deviation: Tensor

    @classmethod
    def of(cls, scores: Tensor) -> Self:
        """Of some scores."""
        scored = scores > -torch.inf
        near = nearness(scores.float()).where(scored, 0)
        count = scored.sum(-1, keepdim=True).clamp(min=1)
        mean = near.sum(-1, keepdim=True) / count
        centred = (near - mean).where(scored, 0)
        return cls(mean, (centred.square().sum(-1, keepdim=True) / count).sqrt())

    def z(self, scores: Tensor) -> Tensor:
        """The nearness of scores in deviations; 0 where there is none."""
        centred = (nearness(scores.float()) - self.mean).where(scores > -torch.inf, 0)
        return centred / self.deviation.clamp(min=MIN_SPREAD)


@torch.no_grad()
def fused(
    scores: Sequence[Tensor], weights: Sequence[float], scales: Sequence[Scale] | None = None
) -> Tensor:
    """``(..., R)`` weighted scores of queries by several methods as one; -inf where no method has a
    score. Scales are those of the scores, if none are given."""
    scales = [Scale.of(each) for each in scores] if scales is None else scales
    every = zip(scores, scales, weights, strict=True)
    parts = [(weight * scale.z(s), *(weight * n for n in scale)) for s, scale, weight in every]
    z, mean, deviation = (sum(part) for part in zip(*parts, strict=True))
    none = torch.stack([each == -torch.inf for each in scores]).all(0)
    return (-torch.expm1(-(mean + deviation * z))).masked_fill(none, -torch.inf)
