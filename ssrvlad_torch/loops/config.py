"""The settings of the loop detector: frozen and validated."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class LoopConfig:
    """The settings of `LoopDetector`; ``docs/loops.md`` shows what each is worth.

    Attributes:
        exclude: the last so many frames are no candidates.
        exclude_seconds: nor are the frames of the last so many seconds, by their stamps.
        temporal: t of Eq. 3, frames summed on each side; 0 for none. The map is so many frames
            late, so they are no candidates either.
        threshold: least strength of a loop, which is the mean of the strengths of the best
            candidates of the last ``confirmations`` frames, this one included.
        relative: 0: the strength of a candidate is its cosine (Eq. 4). N of 1 or more: it says how
            far the candidate stands out. It is the number of standard deviations that the
            logarithm of its distance lies below the mean, both over all candidates that the last
            N frames, this one included, were compared with; each frame weighs the same. One that
            stands out alone among n has the square root of n - 1, so that a strength of 6.7 wants
            a map of 46 candidates at least; where several show the place, of more.
        ratio: no frame of another place may be nearer than the best candidate's distance divided
            by this, as in the ratio test of Lowe (IJCV 2004); distances are Euclidean between
            descriptors. 1 asks for nothing.
        neighbourhood: frames on each side of a frame that show the same place. A place is left
            once more frames than this in a row are below the threshold.
        confirmations: k: the best candidates of the last k frames, this one included, must stay
            together. 1 asks for nothing.
        window: they stay together if from one frame to the next they move at most so many frames,
            forwards or backwards.

    Raises:
        ValueError: a setting is outside its range; the message names it, what was got and what
            was wanted.
    """

    exclude: int = 50
    exclude_seconds: float = 0.0
    temporal: int = 1
    threshold: float = 6.7
    relative: int = 1
    ratio: float = 0.9
    neighbourhood: int = 10
    confirmations: int = 3
    window: int = 3

    def __post_init__(self) -> None:
        _check_integer("exclude", self.exclude, 0, 1 << 31)
        _check_integer("temporal", self.temporal, 0, 100)
        _check_integer("relative", self.relative, 0, 10_000)
        _check_integer("neighbourhood", self.neighbourhood, 0, 10_000)
        _check_integer("confirmations", self.confirmations, 1, 1000)
        _check_integer("window", self.window, 0, 10_000)
        _check_number("exclude_seconds", self.exclude_seconds, 0, math.inf)
        _check_number("threshold", self.threshold, -10, 1000)
        _check_number("ratio", self.ratio, 0, 1)


def _check_integer(name: str, value: object, lowest: int, highest: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
        raise ValueError(f"{name} must be an integer from {lowest} to {highest}, got {value!r}")


def _check_number(name: str, value: object, lowest: float, highest: float) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not lowest <= value <= highest:  # type: ignore[arg-type, operator]
        raise ValueError(
            f"{name} must be a finite number from {lowest} to {highest}, got {value!r}"
        )
