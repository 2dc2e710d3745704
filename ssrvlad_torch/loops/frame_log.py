"""The frames of a live stream, in order, beside the core, which has their descriptors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..database.frames import FrameRecord
from ..native.loops import Loops, LoopStep


class FrameLog:
    """The records of the frames that the core has: the core counts them, and the log follows.

    A record is entered before the core gets its frame, and counts once the core has it. So an
    interrupt between any two lines leaves both with the frame, or both without.

    Args:
        stream: the core's.
    """

    def __init__(self, stream: Loops) -> None:
        self._stream = stream
        self._records: list[FrameRecord] = []  # perhaps more than the core has, after an interrupt
        self._rows: dict[str, int] = {}
        self._stamps: dict[str, float] = {}
        self._indexed = 0

    def __len__(self) -> int:
        return len(self._stream)

    def __getitem__(self, row: int) -> FrameRecord:
        return self._records[range(len(self))[row]]

    def __contains__(self, frame: object) -> bool:
        self._index()
        return frame in self._rows

    def since(self, row: int) -> list[FrameRecord]:
        """The records of the frames from a row on."""
        return self._records[row : len(self)]

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` x and y in metres, heading in radians, NaN where unknown; a copy."""
        poses = [(record.x, record.y, record.heading) for record in self.since(0)]
        return np.array(poses, np.float64).reshape(-1, 3)

    def last_stamp(self, sequence: str) -> float:
        """The last stamp of a sequence in seconds, -inf where there is none."""
        self._index()
        return self._stamps.get(sequence, -math.inf)

    def enter(self, records: Sequence[FrameRecord]) -> None:
        """Enters the next frames, which the core gets then, in place of those that it never got."""
        self._records[len(self) :] = records

    def ahead(self, step: LoopStep) -> float | None:
        """Metres from the candidate along its stretch, see `LoopResult.ahead`."""
        near = self._records[step.first : step.first + len(step.near)]
        places = np.array([(record.x, record.y) for record in near])
        if step.candidate is None or np.isnan(places).any():
            return None
        along = np.cumsum([0.0, *np.hypot(*np.diff(places, axis=0).T)])
        weights = np.array(step.near)
        distances = along - along[step.candidate - step.first]
        return float(weights @ distances / weights.sum())

    def _index(self) -> None:
        """Indexes the frames that the core got since; one that was interrupted again."""
        for row in range(self._indexed, len(self)):
            record = self._records[row]
            self._rows[record.frame] = row
            if not math.isnan(record.stamp):
                last = self._stamps.get(record.sequence, -math.inf)
                self._stamps[record.sequence] = max(last, record.stamp)
            self._indexed = row + 1
