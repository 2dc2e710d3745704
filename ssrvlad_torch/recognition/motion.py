"""Motion: how a sequence moves along the rows of a map, and how likely one frame is at each row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

SPEEDS: tuple[tuple[float, dict[int, float]], ...] = (
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.16, {0: 0.5, 1: 0.5}),
    (0.34, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.16, {1: 0.5, 2: 0.5}),
    (0.14, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""Probability of each speed, and of its steps in rows: 0, 1/2, 1, 3/2, 2, 3, 4 rows a frame."""

FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""

NEAR, ELSEWHERE = 3, 5
"""Rows at most so far apart show the same place, and rows farther apart different places."""

_MIN_STEP, _MAX_STEP = -1, 5
MOST_RATE = 100
"""Highest `Motion.rate`: time and memory grow with its square."""
MIN_SPREAD = 1e-6
MAX_LOG = 50.0
"""Largest logarithm of a likelihood: frames that equal their rows must not overflow float32."""
ROUNDING = 1e-6
"""Rounding error of a cosine of 480 float32 products."""


@dataclass(frozen=True)
class Motion:
    """How a sequence is expected to move, and how much one frame counts.

    The change, weight and level were chosen as docs/recognition.md says.

    Attributes:
        change: probability that the speed changes from one frame to the next.
        jump: probability of a jump to any row, or to a place that the map lacks.
        unmapped: fraction of the jumps that lead to a place that the map lacks.
        stay: probability to stay at such places.
        weight: factor of a z-score in the logarithm of the likelihood. Errors of neighbouring
            frames are correlated, so it is less than for independent frames, where it is 1 or more.
        level: the z-score above which a frame is more likely at the row than at a new place.
        rate: mean number of steps of `SPEEDS` from one frame to the next: 3 for every third frame,
            0.25 for frames four times as dense. At most `MOST_RATE`.

    Raises:
        ValueError: a probability is not from 0 to 1, the weight or the rate not above 0, the rate
            too high, or a number not finite.
    """

    change: float = 0.05
    jump: float = 0.01
    unmapped: float = 0.1
    stay: float = 0.97
    weight: float = 0.3
    level: float = 0.5
    rate: float = 1

    @property
    def gap(self) -> int:
        """The longest step in rows, and the number of empty cells between two sequences."""
        return _MAX_STEP * math.ceil(self.rate)

    @property
    def steps(self) -> range:
        """All steps in rows."""
        return range(_MIN_STEP * math.ceil(self.rate), self.gap + 1)

    def __post_init__(self) -> None:
        for name in ("change", "jump", "unmapped", "stay"):
            if not 0 <= (got := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a probability from 0 to 1, got {got}")
        if not 0 < self.weight < math.inf or not math.isfinite(self.level):
            raise ValueError(
                "expected a finite weight above 0 and a finite level, "
                f"got {self.weight} and {self.level}"
            )
        if not 0 < self.rate <= MOST_RATE:
            raise ValueError(
                f"rate: expected a number above 0, and at most {MOST_RATE}, got {self.rate}"
            )

    def at(self, rate: float) -> Motion:
        """The same motion for frames at another rate: what happens and what is learned on the way
        from one frame to the next are proportional to it."""
        change, jump = (min(1.0, each * rate) for each in (self.change, self.jump))
        return replace(self, rate=rate, change=change, jump=jump, weight=self.weight * rate)

    def unmapped_at_start(self, rows: int) -> float:
        """Probability that a map of so many rows lacks the place of the first frame."""
        return self.unmapped if rows else 1.0

    def off_track(self, lost: float, unmapped: float) -> tuple[float, float]:
        """Probabilities of any row and of an unmapped place, from those of a track that was left
        and of an unmapped place one frame before."""
        any_row = lost * (1 - self.unmapped) + unmapped * (1 - self.stay)
        return any_row, lost * self.unmapped + unmapped * self.stay

    def off_track_back(self, any_row: float, unmapped: float) -> tuple[float, float]:
        """The transpose of `off_track`, for the backward algorithm."""
        lost = (1 - self.unmapped) * any_row + self.unmapped * unmapped
        return lost, self.stay * unmapped + (1 - self.stay) * any_row


class Course(NamedTuple):
    """How queries run a map: `FORWARDS` or `BACKWARDS`, at a rate, see `Motion`, and as how many
    streams whose frames alternate."""

    way: int = FORWARDS
    rate: float = 1
    streams: int = 1

    def __str__(self) -> str:
        parts = (
            "backwards" * (self.way == BACKWARDS),
            f"at rate {self.rate:g}" * (self.rate != 1),
            f"{self.streams} streams in turn" * (self.streams != 1),
        )
        return ", ".join(part for part in parts if part)


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


def likelihoods(
    scores: Tensor, motion: Motion, spread: tuple[float, float] | None = None
) -> Tensor:
    """How much likelier a query is at each row than at a place that the map lacks: ``(R,)``
    float32, ``exp(weight * (z - level))`` of scores ``(R,)`` float, 0 where they are -inf; 1
    everywhere if they are all equal. ``spread`` is the mean and standard deviation of the nearness
    of all rows; without, of these scores."""
    z = nearness(scores.float())
    mean, deviation = _moments(z) if spread is None else spread
    if deviation <= MIN_SPREAD:
        return torch.ones(len(scores))
    z.sub_(mean + motion.level * deviation).mul_(motion.weight / deviation)
    return z.clamp_(max=MAX_LOG).exp_()


def moved(belief: Tensor, motion: Motion, ways: Sequence[int], back: bool = False) -> Tensor:
    """A belief ``(W, 7, cells)`` float32 by way, speed and cell, one frame later, without jumps;
    with ``back`` by the transpose, for the backward algorithm. The first and last `Motion.gap`
    cells stay 0. A track that leaves its sequence is in the gap beside it."""
    after, start, end = torch.empty_like(belief), motion.gap, belief.shape[2] - motion.gap
    after[:, :, :start] = after[:, :, end:] = 0
    for first in range(start, end, CELLS):
        last = min(first + CELLS, end)
        after[:, :, first:last] = 0
        for number, way in enumerate(ways):
            for step, to, source, weights in _shifts(motion, back):
                here = slice(first - way * step, last - way * step)
                after[number, to, first:last].addmm_(weights, belief[number, source, here])
    return after


CELLS = 1 << 14
"""Cells that are moved at once: their beliefs before and after fit into the cache of a core."""


@cache
def _shifts(motion: Motion, back: bool) -> list[tuple[int, slice, slice, Tensor]]:
    """Each step in cells, the speeds after and before it, and the probabilities of the first from
    the second."""
    shifts, any_speed = list[tuple[int, slice, slice, Tensor]](), slice(0, len(SPEEDS))
    for step, by_speed in zip(motion.steps, transitions(motion), strict=True):
        speeds = by_speed.any(1).nonzero().flatten().tolist()
        to = slice(speeds[0], speeds[-1] + 1)
        if back:
            shifts.append((-step, any_speed, to, by_speed[to].T.contiguous()))
        else:
            shifts.append((step, to, any_speed, by_speed[to].contiguous()))
    return shifts


@cache
def transitions(motion: Motion) -> Tensor:
    """``(steps, 7, 7)`` float32, by step, the probabilities after each speed; no jumps."""
    probabilities = torch.zeros(len(motion.steps), len(SPEEDS), len(SPEEDS))
    for speed, (prior, _) in enumerate(SPEEDS):
        by_speed = motion.change * prior * torch.ones(len(SPEEDS))
        by_speed[speed] += 1 - motion.change
        for step, probability in steps_of(speed, motion.rate).items():
            index = motion.steps.index(step)
            probabilities[index, speed] = by_speed * probability * (1 - motion.jump)
    return probabilities


def steps_of(speed: int, rate: float) -> dict[int, float]:
    """The probability of each step in rows at a speed, by its number in `SPEEDS`."""
    steps, whole = {0: 1.0}, math.floor(rate)
    for likely in [1.0] * whole + [rate - whole] * (rate > whole):
        after = {far: (1 - likely) * chance for far, chance in steps.items()}
        for (far, chance), (step, part) in product(steps.items(), SPEEDS[speed][1].items()):
            after[far + step] = after.get(far + step, 0.0) + chance * part * likely
        steps = {far: chance for far, chance in after.items() if chance > 0}
    return steps


def prior_of_speeds() -> Tensor:
    """``(7, 1)`` float32, the probability of each speed; on the default device of this moment."""
    return torch.tensor([probability for probability, _ in SPEEDS])[:, None]
