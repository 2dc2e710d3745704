"""The frames of a live stream so far: ids and poses."""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt

from ..database.frames import FrameRecord
from ..native.loops import Found


class Memory:
    """The frames of a stream, in order.

    Attributes:
        frames: ids.
        rows: the row of each id.
    """

    def __init__(self) -> None:
        self.frames: list[str] = []
        self.rows: dict[str, int] = {}
        self._poses = array("d")

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` x and y in metres, heading in radians, NaN where unknown; a copy."""
        return np.array(self._poses, np.float64).reshape(-1, 3)

    def append(self, record: FrameRecord) -> None:
        """Appends a frame."""
        self.rows[record.frame] = len(self.frames)
        self.frames.append(record.frame)
        self._poses.extend((record.x, record.y, record.heading))

    def ahead(self, found: Found) -> float | None:
        """Metres from the candidate along its stretch, see `LoopResult.ahead`."""
        last = found.first + len(found.near)
        poses = np.array(self._poses[3 * found.first : 3 * last], np.float64).reshape(-1, 3)
        if found.candidate is None or np.isnan(poses[:, :2]).any():
            return None
        along = np.cumsum([0.0, *np.hypot(*np.diff(poses[:, :2], axis=0).T)])
        weights = np.array(found.near)
        return float(weights @ (along - along[found.candidate - found.first]) / weights.sum())
