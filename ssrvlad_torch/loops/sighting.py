"""What the checks of one's own are told of a frame: a pose gate, a geometric check."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

KeyPoints = npt.NDArray[np.int16]
"""``(P, 3)``: category, row and column of each keypoint on the working grid."""


class Sighting(NamedTuple):
    """A frame as it is known beside its descriptor.

    Attributes:
        frame: its id.
        pose: ``(3,)`` x and y in metres and heading in radians, NaN where unknown.
        stamp: seconds, -inf where unknown.
        keypoints: ``(P, 3)`` int16, category, row and column on the working grid; ``None`` for a
            frame that came as a descriptor or from a database.
    """

    frame: str
    pose: npt.NDArray[np.float64]
    stamp: float
    keypoints: KeyPoints | None


PoseGate = Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.bool_]]
"""``gate(pose, poses)``: a frame's ``(3,)`` pose and the ``(N, 3)`` poses of earlier ones, as in
`Sighting` -> ``(N,)`` bool, whether each can be the same place."""

GeometricCheck = Callable[[Sighting, Sighting], bool]
"""``check(here, there)``: whether a frame and its candidate can be the same place."""
