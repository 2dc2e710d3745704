"""Motion: how a sequence moves along the rows of a map, and what one frame says of its place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

SPEEDS: tuple[tuple[float, dict[int, float]], ...] = (
    (0.04, {-2: 0.1, -1: 0.8, 0: 0.1}),
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.15, {0: 0.5, 1: 0.5}),
    (0.33, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.15, {1: 0.5, 2: 0.5}),
    (0.13, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""How likely each speed is, and its steps in rows: backwards, standing, 1/2, 1, 3/2, 2, 3, 4."""

GAP = 5
"""No step is longer: so many empty cells keep two sequences apart."""

_BLOCK = 1 << 14
_LEAST_SPREAD = 1e-6
_MOST = 50.0
"""Of the logarithm of evidence: frames that equal their rows must not overflow float32."""
_ROUNDING = 1e-6
"""Cosines of 480 float32 products are no more exact than this."""


@dataclass(frozen=True)
class Motion:
    """What a sequence is expected to do, and how much one frame says.

    Attributes:
        change: chance that the speed changes from one frame to the next.
        jump: chance to leave the track: to any row, or to a place that the map lacks.
        unmapped: the part of the jumps that go to a place that the map lacks.
        stay: chance to stay at such places.
        weight: what one z-score counts. Frames in a row err alike, so it is less than the 1 or
            more of independent ones.
        level: the z-score from which on a frame speaks for a row rather than for a new place.

    Raises:
        ValueError: a chance is not from 0 to 1, the weight not above 0, or a number not finite.
    """

    change: float = 0.05
    jump: float = 0.01
    unmapped: float = 0.1
    stay: float = 0.97
    weight: float = 0.3
    level: float = 1.0

    def __post_init__(self) -> None:
        for name in ("change", "jump", "unmapped", "stay"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(
                    f"{name}: expected a chance from 0 to 1, got {getattr(self, name)}"
                )
        if not 0 < self.weight < math.inf or not math.isfinite(self.level):
            raise ValueError(
                "expected a finite weight above 0 and a finite level, "
                f"got {self.weight} and {self.level}"
            )


def nearness(scores: Tensor) -> Tensor:
    """Less the logarithm of half the squared Euclidean distance of descriptors of length 1."""
    return -torch.log((1 - scores).clamp(min=_ROUNDING))


def moments(scores: Tensor) -> tuple[float, float]:
    """Mean and standard deviation of the nearness of scores, those that are -inf left out."""
    near = nearness(scores[scores > -torch.inf])
    if not len(near):
        return 0.0, _LEAST_SPREAD
    return float(near.mean()), max(_LEAST_SPREAD, float(near.std(correction=0)))


def evidence(scores: Tensor, motion: Motion, spread: tuple[float, float] | None = None) -> Tensor:
    """How much more likely a query is at each row than at a place that the map lacks.

    Args:
        scores: ``(R,)`` float cosines, -inf where there can be no match.
        motion: its weight and level.
        spread: mean and standard deviation of the nearness of all rows; without, of these.

    Returns:
        ``(R,)`` float32, ``exp(weight * (z - level))``, 0 where there can be no match. Scores that
        are all equal or all -inf say nothing: 1 everywhere.
    """
    mean, deviation = moments(scores) if spread is None else spread
    if deviation <= _LEAST_SPREAD:
        return torch.ones(len(scores))
    z = (nearness(scores.float()) - mean) / deviation
    told = torch.exp((motion.weight * (z - motion.level)).clamp_(max=_MOST))
    return told.masked_fill_(scores == -torch.inf, 0)


def moved(belief: Tensor, motion: Motion) -> Tensor:
    """Where a belief is one frame later.

    Args:
        belief: ``(8, cells)`` float32 by speed and cell, 0 in the first and last `GAP` cells.

    Returns:
        likewise, without what jumps; what left the map is in the gaps.
    """
    after = torch.zeros_like(belief)
    cells, prior = belief.shape[1], prior_of_speeds()
    for first in range(GAP, cells - GAP, _BLOCK):
        last = min(first + _BLOCK, cells - GAP)
        part = belief[:, first - GAP : last + GAP]
        mixed = part * (1 - motion.change) + motion.change * prior * part.sum(0)
        for speed, (_, steps) in enumerate(SPEEDS):
            for step, chance in steps.items():
                start = GAP - step
                after[speed, first:last].add_(
                    mixed[speed, start : start + last - first],
                    alpha=chance * (1 - motion.jump),
                )
    return after


def moved_back(belief: Tensor, motion: Motion) -> Tensor:
    """The transpose of `moved`."""
    before = torch.zeros_like(belief)
    cells, prior = belief.shape[1], prior_of_speeds()
    for first in range(GAP, cells - GAP, _BLOCK):
        last = min(first + _BLOCK, cells - GAP)
        part = before[:, first:last]
        for speed, (_, steps) in enumerate(SPEEDS):
            for step, chance in steps.items():
                part[speed].add_(
                    belief[speed, first + step : last + step], alpha=chance * (1 - motion.jump)
                )
        before[:, first:last] = part * (1 - motion.change) + motion.change * (prior * part).sum(0)
    return before


def prior_of_speeds() -> Tensor:
    """``(8, 1)`` float32."""
    return torch.tensor([chance for chance, _ in SPEEDS])[:, None]
