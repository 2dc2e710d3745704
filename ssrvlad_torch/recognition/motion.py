"""Motion: how a sequence moves along the rows of a map, and how far apart rows show the same place.

It needs no torch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

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


def steps_of(speed: int, rate: float) -> dict[int, float]:
    """The probability of each step in rows at a speed, by its number in `SPEEDS`."""
    steps, whole = {0: 1.0}, math.floor(rate)
    for likely in [1.0] * whole + [rate - whole] * (rate > whole):
        after = {far: (1 - likely) * chance for far, chance in steps.items()}
        for (far, chance), (step, part) in product(steps.items(), SPEEDS[speed][1].items()):
            after[far + step] = after.get(far + step, 0.0) + chance * part * likely
        steps = {far: chance for far, chance in after.items() if chance > 0}
    return steps
