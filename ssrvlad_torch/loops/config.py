"""The settings of the loop detector: frozen and validated."""

import operator
from dataclasses import dataclass
from numbers import Real


@dataclass(frozen=True)
class LoopConfig:
    """The settings of `LoopDetector`.

    Attributes:
        exclude: number of the last frames of the same sequence, which are no candidates. The
            default is for frames about 3 m apart; exclude more where they are denser.
        threshold: least confidence of a loop, 0 to 1.
        sweep: whether to describe each frame from three anchors, so that a slightly turned camera
            still matches; without effect on descriptors without anchors, such as ``paper``.

    Raises:
        ValueError: a setting is outside its range.
    """

    exclude: int = 50
    threshold: float = 0.8
    sweep: bool = True

    def __post_init__(self) -> None:
        exclude, threshold = self.exclude, self.threshold
        whole = hasattr(exclude, "__index__") and not isinstance(exclude, bool)
        if not whole or exclude < 0:
            raise ValueError(f"exclude: expected an integer from 0, got {exclude!r}")
        object.__setattr__(self, "exclude", operator.index(exclude))
        number = isinstance(threshold, Real) and not isinstance(threshold, bool)
        if not number or not 0 <= threshold <= 1:
            raise ValueError(f"threshold: expected a number from 0 to 1, got {threshold!r}")
        if not isinstance(self.sweep, bool):
            raise ValueError(f"sweep: expected a bool, got {self.sweep!r}")
