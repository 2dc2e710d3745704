"""The frames of a live stream so far: ids, poses, and what each channel knows of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..channels.channel import Channel, Live
from ..channels.live_vectors import GrowingArray
from ..database.frames import FrameRecord
from .stretches import RECENT, is_elsewhere, is_gap

Described = dict[str, npt.NDArray[Any]]
"""The descriptors of a frame by the names of the channels."""


class Memory:
    """The frames of a stream, in order.

    Attributes:
        lives: the descriptors by the names of the channels.
        frames: ids.
        rows: the row of each id.
        start: the row of the first frame of the present stretch, see `loops.stretches`.
        stretches: of each frame, the id of the first frame of its stretch.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.lives: dict[str, Live] = {each.column.name: each.live() for each in channels}
        self.trust = {each.column.name: each.trust for each in channels}
        self.frames: list[str] = []
        self.rows: dict[str, int] = {}
        self.stretches: list[str] = []
        self.start = 0
        self._poses, self._stamps = GrowingArray(np.float64, 3), GrowingArray(np.float64)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def first(self) -> Live:
        """The descriptors of the first channel; a frame is empty if its one is zero."""
        return next(iter(self.lives.values()))

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` x and y in metres, heading in radians, NaN where unknown; a view."""
        return self._poses.values

    def checked(self, descriptors: Mapping[str, Tensor] | Tensor, frame: str) -> Described:
        """The descriptors of a new frame from its anchors, see `Live.checked`; those of other
        channels are a ValueError."""
        given = descriptors
        if isinstance(given, Tensor):
            given = {next(iter(self.lives)): given}
        if given.keys() != self.lives.keys():
            names, got = (", ".join(each) or "nothing" for each in (self.lives, given))
            raise ValueError(f"frame {frame!r}: expected descriptors by {names}, got {got}")
        return {name: live.checked(given[name], frame) for name, live in self.lives.items()}

    def start_stretch(self) -> None:
        """The next frame starts another stretch."""
        self.start = len(self)
        for live in self.lives.values():
            live.start_sequence()

    def breaks(self, stamp: float, descriptors: Described) -> bool:
        """Whether the next frame of the sequence, by its descriptors from the usual anchor, starts
        another stretch."""
        first = max(self.start, len(self) - RECENT)
        if not is_gap(self._stamps.values[first:], stamp):
            return False
        return is_elsewhere(
            np.concatenate((live.descriptors(first, len(self)), descriptors[name][None]))
            for name, live in self.lives.items()
        )

    def place(self, record: FrameRecord) -> None:
        """Appends what is known of a frame, whose descriptors are added to each channel."""
        self.rows[record.frame] = len(self.frames)
        self.frames.append(record.frame)
        self.stretches.append(self.frames[self.start])
        self._poses.append((record.x, record.y, record.heading))
        self._stamps.append(record.stamp)

    def append(self, record: FrameRecord, descriptors: Described) -> None:
        """Appends a frame with its descriptors from the usual anchor."""
        self.place(record)
        for name, live in self.lives.items():
            live.add(descriptors[name])
