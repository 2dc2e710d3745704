"""Motion: how a sequence moves along the rows of a map, and what one frame says of its place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

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

ELSEWHERE = 5
"""Rows that are farther apart show different places."""

_LEAST_STEP = min(step for _, steps in SPEEDS for step in steps)
LEAST_SPREAD = 1e-6
_MOST = 50.0
"""Of the logarithm of evidence: frames that equal their rows must not overflow float32."""
_ROUNDING = 1e-6
"""Cosines of 480 float32 products are no more exact than this."""


@dataclass(frozen=True)
class Motion:
    """What a sequence is expected to do, and how much one frame says.

    The change, weight and level are chosen by `scripts/pages/choose_motion.py`; see
    docs/recognition.md.

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
    level: float = 0.5

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
    """Minus the logarithm of half the squared Euclidean distance of descriptors of length 1."""
    return (1 - scores).clamp_(min=_ROUNDING).log_().neg_()


def lead(near: Tensor, rows: Tensor | None = None) -> Tensor:
    """``(Q,)``: how much nearer the first candidate is than the best one elsewhere, see
    `ELSEWHERE`; infinite where nothing is elsewhere. ``near`` ``(Q, N)`` is the nearness of the
    rows ``(N,)``, rising, of the map, or of all."""
    rows = torch.arange(near.shape[1]) if rows is None else rows
    apart = (rows - rows[near.argmax(1)][:, None]).abs()
    return near.amax(1) - near.masked_fill(apart <= ELSEWHERE, -torch.inf).amax(1)


def moments(scores: Tensor) -> tuple[float, float]:
    """Mean and standard deviation of the nearness of scores, those that are -inf left out."""
    return _moments(nearness(scores))


def _moments(near: Tensor) -> tuple[float, float]:
    if not len(near):
        return 0.0, LEAST_SPREAD
    least, most = map(float, near.aminmax())
    if least == -torch.inf:
        return _moments(near[near > -torch.inf])
    if most - least <= LEAST_SPREAD:
        return least, LEAST_SPREAD
    mean = float(near.mean())
    deviation = math.sqrt(float((near - mean).square_().mean()))
    return mean, max(LEAST_SPREAD, deviation)


def evidence(scores: Tensor, motion: Motion, spread: tuple[float, float] | None = None) -> Tensor:
    """How much more likely a query is at each row than at a place that the map lacks.

    Args:
        scores: ``(R,)`` float cosines, -inf where there can be no match.
        motion: its weight and level.
        spread: mean and standard deviation of the nearness of all rows; without, of these.

    Returns:
        ``(R,)`` float32, ``exp(weight * (z - level))``, 0 where there can be no match; 1 everywhere
        if scores are all equal or all -inf.
    """
    z = nearness(scores.float())
    mean, deviation = _moments(z) if spread is None else spread
    if deviation <= LEAST_SPREAD:
        return torch.ones(len(scores))
    z.sub_(mean + motion.level * deviation).mul_(motion.weight / deviation)
    return z.clamp_(max=_MOST).exp_()


def moved(belief: Tensor, motion: Motion, back: bool = False) -> Tensor:
    """A belief ``(8, cells)`` float32 by speed and cell, one frame later, without what jumps;
    ``back`` is the transpose, for the backward algorithm. The first and last `GAP` cells stay 0;
    what left the map is in the gaps between sequences."""
    after, end = torch.empty_like(belief), belief.shape[1] - GAP
    after[:, :GAP] = after[:, end:] = 0
    for first in range(GAP, end, CELLS):
        last = min(first + CELLS, end)
        after[:, first:last] = 0
        for step, there, here, ways in _ways(motion, back):
            after[there, first:last].addmm_(ways, belief[here, first - step : last - step])
    return after


CELLS = 1 << 15
"""Cells that are moved at once: their beliefs, before and after, fit the cache of a core."""


class _Way(NamedTuple):
    """A step in cells, the speeds to which and from which it leads, and with which chances."""

    step: int
    there: slice
    here: slice
    chances: Tensor


@cache
def _ways(motion: Motion, back: bool) -> tuple[_Way, ...]:
    ways, any_speed = [], slice(0, len(SPEEDS))
    for step in range(_LEAST_STEP, GAP + 1):
        speeds = [speed for speed, (_, steps) in enumerate(SPEEDS) if step in steps]
        there = slice(speeds[0], speeds[-1] + 1)
        to = chances(motion)[there, :, GAP - step]
        way = _Way(-step, any_speed, there, to.T) if back else _Way(step, there, any_speed, to)
        ways.append(way._replace(chances=way.chances.contiguous()))
    return tuple(ways)


@cache
def chances(motion: Motion) -> Tensor:
    """``(8, 8, taps)``: to each speed from each, the chance to come from so many cells away; the
    first tap is the longest step."""
    chances = torch.zeros(len(SPEEDS), len(SPEEDS), GAP - _LEAST_STEP + 1)
    for speed, (prior, steps) in enumerate(SPEEDS):
        kept = motion.change * prior * torch.ones(len(SPEEDS))
        kept[speed] += 1 - motion.change
        for step, chance in steps.items():
            chances[speed, :, GAP - step] = kept * chance * (1 - motion.jump)
    return chances


def prior_of_speeds() -> Tensor:
    """``(8, 1)`` float32."""
    return torch.tensor([chance for chance, _ in SPEEDS])[:, None]
