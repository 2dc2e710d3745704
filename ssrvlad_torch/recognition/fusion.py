"""Fusion: the scores of several methods as one, no labels needed.

Label maps and pictures err at different places. What a method says of a query is put on one scale,
in standard deviations from its mean over all references, and each method weighs by how far its
first candidates stand out on the traverse at hand. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .motion import ELSEWHERE, lead, nearness

_LEAST_SPREAD = 1e-6


class Fused(NamedTuple):
    """Scores of all methods together.

    Attributes:
        scores: ``(Q, R)`` float32, at most 1; -inf where no method has a score.
        weights: of each method; their sum is 1.
    """

    scores: Tensor
    weights: tuple[float, ...]


@torch.no_grad()
def fuse_scores(scores: Sequence[Tensor]) -> Fused:
    """The scores of one traverse of queries by several methods as one.

    The result is of the form of cosines, for `follow` and `recognise_by_scores`. A method that has
    no score of a pair, for it is empty to it, leaves it to the others.

    Args:
        scores: of each method ``(Q, R)`` float, at most 1, higher for what is more alike; -inf
            where there can be no match.

    Raises:
        ValueError: there are none, or they are of different shapes.

    Example:
        >>> here, there = torch.eye(20), torch.eye(20).roll(1, 0)
        >>> fuse_scores([here, here, there]).scores.argmax(1).equal(torch.arange(20))
        True
    """
    shapes = {tuple(one.shape) for one in scores}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        got = ", ".join(str(tuple(one.shape)) for one in scores) or "none"
        raise ValueError(f"expected scores (Q, R) of one shape, got {got}")
    scaled = [_scaled(one.float()) for one in scores]
    leads = torch.stack([_lead(one.z) for one in scaled])
    leads = leads.clamp(min=0)
    weights = leads / leads.sum() if float(leads.sum()) > 0 else leads.fill_(1 / len(leads))

    z, mean, spread = (
        sum(weight * part for weight, part in zip(weights, parts, strict=True))
        for parts in zip(*scaled, strict=True)
    )
    fused = -torch.expm1(-(mean + spread * z))
    none = torch.stack([one == -torch.inf for one in scores]).all(0)
    return Fused(fused.masked_fill(none, -torch.inf), tuple(weights.tolist()))


class _Scaled(NamedTuple):
    """``(Q, R)`` nearness in standard deviations from its mean; ``(Q, 1)`` mean and deviation."""

    z: Tensor
    mean: Tensor
    spread: Tensor


def _scaled(scores: Tensor) -> _Scaled:
    scored = scores > -torch.inf
    near = nearness(scores).where(scored, 0)
    count = scored.sum(1, keepdim=True).clamp(min=1)
    mean = near.sum(1, keepdim=True) / count
    apart = (near - mean).where(scored, 0)
    spread = (apart.square().sum(1, keepdim=True) / count).sqrt()
    return _Scaled(apart / spread.clamp(min=_LEAST_SPREAD), mean, spread)


def _lead(z: Tensor) -> Tensor:
    """How far first candidates are ahead, on average; 0 where that cannot be told."""
    if not len(z) or z.shape[1] <= 2 * ELSEWHERE + 1:
        return torch.tensor(0.0)
    return lead(z).mean()
