"""Fusion: the scores of several methods as one, no labels needed.

Label maps and pictures err at different places. The scores of a method for a query are put on one
scale, in standard deviations from their mean over all references, and each method weighs by how far
its first candidates stand out on the traverse. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .follow import Scores
from .motion import ELSEWHERE, lead, nearness
from .standardise import LEAST

_SAMPLE = 200
_LEAST_SPREAD = 1e-6


class FusedScores(Scores):
    """The scores of one traverse of queries by several methods as one, made as they are asked for.

    They have the form of cosines, for `follow` and `recognise_by_scores`. Where a method has no
    score of a pair, the others decide. Of fewer queries than `standardise.LEAST` the methods weigh
    alike: so few do not show which to trust.

    Args:
        members: of each method ``(Q, R)`` float, at most 1, higher for what is more alike; -inf
            where there can be no match.

    Attributes:
        weights: of each method; their sum is 1.

    Raises:
        ValueError: there are none, or they are of different shapes.

    Example:
        >>> here, there = torch.eye(20), torch.eye(20).roll(1, 0)
        >>> FusedScores([here, here, there]).whole().argmax(1).equal(torch.arange(20))
        True
    """

    def __init__(self, members: Sequence[Scores]) -> None:
        shapes = {(len(one), *one[0].shape) if len(one) else (0,) for one in members}
        if len(shapes) != 1 or len(next(iter(shapes))) != 2:
            got = ", ".join(map(str, shapes)) or "none"
            raise ValueError(f"expected scores (Q, R) of one shape, got {got}")
        self._members = members
        self.weights = weights_of(self._leads())

    def __len__(self) -> int:
        return len(self._members[0])

    def __getitem__(self, query: int, /) -> Tensor:
        return fused([one[query] for one in self._members], self.weights)

    def whole(self) -> Tensor:
        """``(Q, R)`` float32."""
        return torch.stack([self[query] for query in range(len(self))])

    def _leads(self) -> list[float]:
        """How far the first candidates of each method are ahead, on average over a sample."""
        count = len(self)
        if count < LEAST:
            return [0.0] * len(self._members)
        sample = range(0, count, max(1, count // _SAMPLE))
        return [sum(map(ahead, (one[q] for q in sample))) / len(sample) for one in self._members]


def weights_of(leads: Sequence[float]) -> tuple[float, ...]:
    """What each method weighs by how far its first candidates are ahead; their sum is 1."""
    above = [max(0.0, one) for one in leads]
    total = sum(above)
    return tuple(one / total if total > 0 else 1 / len(above) for one in above)


def ahead(scores: Tensor) -> float:
    """How far the first candidate of a query is ahead of the best one elsewhere, in standard
    deviations of the nearness of ``(R,)`` scores; 0 if there are too few."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    return float(lead(_scaled(scores).z[None]))


@torch.no_grad()
def fused(scores: Sequence[Tensor], weights: Sequence[float], among: int | None = None) -> Tensor:
    """``(R,)`` scores of one query by several methods, fused by their weights; -inf where no method
    has a score. Mean and deviation are those of the first ``among`` rows; without, of all."""
    scaled = [_scaled(one, among) for one in scores]
    z, mean, spread = (
        sum(weight * part for weight, part in zip(weights, parts, strict=True))
        for parts in zip(*scaled, strict=True)
    )
    none = torch.stack([one == -torch.inf for one in scores]).all(0)
    return (-torch.expm1(-(mean + spread * z))).masked_fill(none, -torch.inf)


class _Scaled(NamedTuple):
    """``(R,)`` nearness in standard deviations from its mean; mean and deviation."""

    z: Tensor
    mean: Tensor
    spread: Tensor


def _scaled(scores: Tensor, among: int | None = None) -> _Scaled:
    scored = scores > -torch.inf
    near = nearness(scores.float()).where(scored, 0)
    count = scored[:among].sum().clamp(min=1)
    mean = near[:among].sum() / count
    apart = (near - mean).where(scored, 0)
    spread = (apart[:among].square().sum() / count).sqrt()
    return _Scaled(apart / spread.clamp(min=_LEAST_SPREAD), mean, spread)
