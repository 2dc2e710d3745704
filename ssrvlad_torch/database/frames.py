"""Frames of a database: their records, and sets of them in memory."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..datasets.names import id_of, split_id

if TYPE_CHECKING:
    from torch import Tensor


class FrameRecord(NamedTuple):
    """What a database stores of a frame beside its descriptors.

    Attributes:
        sequence, name: the frame's id is ``<sequence>/<name>``, or the name if there is no
            sequence. A name holds no ``/``.
        x, y: position in metres, NaN if unknown.
        heading: radians, counter-clockwise from +x, NaN if unknown.
        stamp: time when the frame was taken, in seconds, NaN if unknown.
        signature: a text that changes whenever the frame's file does: the file's folder, ``|``, and
            its state.
        digest: of the label map, in hex.
        height, width: size of the label map in pixels.
        origin: label space and segmenter of the label map, a key of `Database.origins`.
        arrival: number of the frame in the stream that a `LoopDetector` saved, -1 for other frames.
    """

    sequence: str
    name: str
    x: float = math.nan
    y: float = math.nan
    heading: float = math.nan
    stamp: float = math.nan
    signature: str = ""
    digest: str = ""
    height: int = 0
    width: int = 0
    origin: str = ""
    arrival: int = -1

    @property
    def frame(self) -> str:
        """The frame's id."""
        return id_of(self.sequence, self.name)

    @classmethod
    def of_id(cls, frame: str) -> FrameRecord:
        """A record with only the frame's id; a ValueError if the text is not one."""
        sequence, name = split_id(frame)
        parts = (sequence, name) if "/" in frame else (name,)
        if not all(text and text == text.strip() for text in parts):
            raise ValueError(f"expected a frame id, <sequence>/<name> or <name>, got {frame!r}")
        return cls(sequence, name)


@dataclass(frozen=True)
class FrameSet:
    """Frames in memory, by sequence and name in natural order.

    Attributes:
        frames: ids.
        sequences: the sequence of each frame.
        channels: ``(R, *shape)`` descriptors by the name of their column, see `Database.columns`;
            raw: neither summed over time nor centred.
        poses: ``(R, 3)`` float64, x and y in metres and heading in radians, NaN if unknown.
        stamps: ``(R,)`` float64, seconds, NaN if unknown.
        empty: ``(R,)`` bool, frames whose first descriptor is zero; they match nothing.
    """

    frames: tuple[str, ...]
    sequences: tuple[str, ...]
    channels: Mapping[str, Tensor]
    poses: npt.NDArray[np.float64]
    stamps: npt.NDArray[np.float64]
    empty: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        posed = int((~np.isnan(self.poses[:, 0])).sum())
        names = " and ".join(self.channels)
        return (
            f"<FrameSet: {len(self)} frames of {len(set(self.sequences))} sequences, {names}, "
            f"{int(self.empty.sum())} empty, {posed} with a pose>"
        )

    @property
    def descriptors(self) -> Tensor:
        """``(R, D)`` float32, those of the first channel: of label maps, or custom ones."""
        return next(iter(self.channels.values()))


def require_list(frames: Collection[object]) -> None:
    """Raises ValueError for a single text, whose letters would be ids."""
    if isinstance(frames, str):
        raise ValueError(f"expected a list of frames, got the text {frames!r}")


def is_text(frame: object) -> bool:
    """Whether a frame's id can be stored: a text without bytes that are not UTF-8."""
    try:
        return isinstance(frame, str) and bool(frame.encode())
    except UnicodeEncodeError:
        return False


def checked_pose(pose: Sequence[float] | None, frame: str) -> tuple[float, float, float]:
    """A pose as three numbers, NaN where unknown; half a position, infinite numbers and what are no
    numbers are a ValueError."""
    if pose is None:
        return math.nan, math.nan, math.nan
    numbers = numbers_of(pose)
    half = len({math.isnan(number) for number in numbers[:2]}) > 1
    if len(numbers) not in (2, 3) or any(map(math.isinf, numbers)) or half:
        raise ValueError(f"frame {frame!r}: expected a pose of finite x, y, heading, got {pose!r}")
    x, y, heading = (*numbers, math.nan)[:3]
    return x, y, heading


def numbers_of(values: Iterable[object]) -> list[float]:
    """The numbers; none if a value is another thing, also the text of a number."""
    try:
        listed: list[Any] = [*values]
        return (
            [] if any(isinstance(value, str | bytes) for value in listed) else [*map(float, listed)]
        )
    except (TypeError, ValueError, OverflowError):
        return []
