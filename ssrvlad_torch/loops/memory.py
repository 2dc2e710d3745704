"""The frames of a live stream so far: ids, poses, and what each channel knows of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..channels.channel import Channel, Live
from ..channels.live_vectors import GrowingArray
from ..datasets.names import sequence_of

Described = dict[str, npt.NDArray[Any]]
"""The descriptors of a frame by the names of the channels."""


class Memory:
    """The frames of a stream, in order.

    Attributes:
        lives: the descriptors by the names of the channels.
        frames: ids.
        rows: the row of each id.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.lives: dict[str, Live] = {each.column.name: each.live() for each in channels}
        self.trust = {each.column.name: each.trust for each in channels}
        self.frames: list[str] = []
        self.rows: dict[str, int] = {}
        self._poses = GrowingArray(np.float64, 3)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def first(self) -> Live:
        """The descriptors of the first channel; a frame is empty if its one is zero."""
        return next(iter(self.lives.values()))

    @property
    def sequence(self) -> str | None:
        """The sequence of the last frame."""
        return sequence_of(self.frames[-1]) if self.frames else None

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

    def place(self, frame: str, pose: Sequence[float]) -> None:
        """Appends the id and the pose of a frame, whose descriptors are added to each channel."""
        self.rows[frame] = len(self.frames)
        self.frames.append(frame)
        self._poses.append(pose)

    def append(self, frame: str, pose: Sequence[float], descriptors: Described) -> None:
        """Appends a frame with its descriptors from the usual anchor."""
        self.place(frame, pose)
        for name, live in self.lives.items():
            live.add(descriptors[name])
