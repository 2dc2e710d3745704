"""What a loop detector keeps of every frame beside its descriptor, in memory and in a file."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import replacing
from .memory import GrowingArray
from .sighting import KeyPoints, Sighting

_ENTRY = np.dtype(
    [
        ("frame", np.uint32),  # CRC-32 of the id
        ("pose", np.float64, 3),
        ("stamp", np.float64),
        ("candidate", np.int64),
        ("strength", np.float64),
        ("confirmed", np.int64),
        ("mean", np.float64),
        ("square", np.float64),
        ("place", np.int64),  # the first row that is known to show the frame's place
    ]
)
_SAVED = ("frame", "stamp", "candidate", "strength", "confirmed", "mean", "square")


class LoopLog:
    """One entry a frame, in the order of the stream."""

    def __init__(self) -> None:
        self._entries = GrowingArray(_ENTRY)
        self._rows: dict[str, int] = {}
        self._frames: list[str] = []
        self._keypoints: dict[int, KeyPoints] = {}
        self._sequence: str | None = None
        self._sequence_start = 0

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, frame: object) -> bool:
        return frame in self._rows

    @property
    def frames(self) -> list[str]:
        """Ids of all frames in order."""
        return self._frames.copy()

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` float64, x and y in metres, heading in radians, NaN where unknown."""
        return self._column("pose")

    @property
    def stamps(self) -> npt.NDArray[np.float64]:
        """``(N,)`` float64, seconds, -inf where unknown."""
        return self._column("stamp")

    def frame(self, row: int) -> str:
        """Id of a frame."""
        return self._frames[row]

    def sighting(self, row: int) -> Sighting:
        """A frame as it was added."""
        pose, stamp = self.poses[row].copy(), float(self.stamps[row])
        return Sighting(self._frames[row], pose, stamp, self._keypoints.get(row))

    def append(self, sighting: Sighting) -> None:
        """Adds a frame of which nothing was concluded."""
        frame, pose, stamp, keypoints = sighting
        row = len(self)
        self._sequence_start = self.start_of_sequence(frame)
        self._sequence = frame.rpartition("/")[0]
        self._entries.append((_crc(frame), pose, stamp, -1, np.nan, 0, np.nan, np.nan, row))
        if keypoints is not None:
            self._keypoints[row] = keypoints
        self._frames.append(frame)
        self._rows[frame] = row

    def conclude(
        self, candidate: int, strength: float, moments: tuple[float, float], confirmed: int
    ) -> None:
        """Completes the last frame's entry.

        Args:
            candidate: row of its best candidate.
            strength: of that candidate.
            moments: mean, and mean square, of the nearness of all candidates.
            confirmed: how many of the last frames show, as this one does, the places of their
                candidates; 0 for none.
        """
        last = self._entries.values[-1:]
        last["candidate"], last["strength"], last["confirmed"] = candidate, strength, confirmed
        last["mean"], last["square"] = moments
        self._link(len(self) - 1)

    def start_of_sequence(self, frame: str) -> int:
        """Row with which the sequence of the frame to come began."""
        same = frame.rpartition("/")[0] == self._sequence
        return self._sequence_start if same else len(self)

    def same_place(self, row: int, reach: int) -> npt.NDArray[np.int64]:
        """Rows of the frames that show the place of one, on every visit that is known.

        They are at most ``reach`` frames away from it: from row to row, and by the loop from a
        row to the first one that is known to show its place.
        """
        places = self._column("place")
        apart = np.abs(places - places[row])
        visits = np.flatnonzero(apart <= reach)
        steps = np.arange(-reach, reach + 1)
        near = np.abs(steps) + apart[visits, None] <= reach
        around: npt.NDArray[np.int64] = (visits[:, None] + steps)[near]
        return around[(around >= 0) & (around < len(self))]

    def candidates(self, count: int) -> npt.NDArray[np.int64]:
        """Rows of the best candidates of the last so many frames, -1 where there was none."""
        return self._column("candidate")[len(self) - count :]

    def strengths(self, count: int) -> npt.NDArray[np.float64]:
        """Strengths of those candidates, NaN where there was none; fewer at the beginning."""
        return self._column("strength")[max(0, len(self) - count) :]

    def moments(self, count: int) -> npt.NDArray[np.float64]:
        """``(count, 2)``: moments of the last so many frames, NaN where there were none."""
        first = max(0, len(self) - count)
        return np.stack([self._column(name)[first:] for name in ("mean", "square")], axis=1)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """A copy of what `write_state` writes."""
        return {name: self._column(name).copy() for name in _SAVED}

    def restore(
        self, frames: list[str], poses: npt.NDArray[np.float64], state: dict[str, Any]
    ) -> None:
        """Fills an empty log.

        Args:
            frames: N ids.
            poses: ``(N, 3)``.
            state: from `read_state`; entries beyond the N frames are passed over, and frames
                beyond the entries have none.

        Raises:
            ValueError: the entries are of other frames; the message names the first.
        """
        stamps = np.maximum.accumulate(state["stamp"])
        for row, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
            if row >= len(stamps):
                self.append(Sighting(frame, pose, -np.inf, None))
                continue
            if state["frame"][row] != _crc(frame):
                raise ValueError(f"frame {frame!r} has the entry of another frame")
            self.append(Sighting(frame, pose, float(stamps[row]), None))
            moments = state["mean"][row], state["square"][row]
            found = state["candidate"][row], state["strength"][row]
            self.conclude(*found, moments, state["confirmed"][row])

    def _column(self, name: str) -> npt.NDArray[Any]:
        return self._entries.values[name]

    def _link(self, row: int) -> None:
        """The places of the frames that this one confirms are those of their candidates."""
        place, candidate = self._column("place"), self._column("candidate")
        for shown in range(row + 1 - int(self._column("confirmed")[row]), row + 1):
            place[shown] = place[candidate[shown]]


def _crc(frame: str) -> int:
    return zlib.crc32(frame.encode(errors="surrogateescape"))


def write_state(path: Path, state: dict[str, npt.NDArray[Any]]) -> None:
    """Writes a log's state, whole or not at all.

    Raises:
        OSError: the disk refused.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **state)


def read_state(path: Path) -> dict[str, npt.NDArray[Any]]:
    """What `write_state` wrote, its checksums verified; without a file, the state of no frames.

    Raises:
        ValueError: the file is damaged; the message names it.
    """
    if not path.exists():
        return {name: np.empty(0, _ENTRY[name]) for name in _SAVED}
    try:
        with np.load(path, allow_pickle=False) as file:
            state = {name: file[name] for name in _SAVED}
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is damaged: {' '.join(str(error).split())}") from error
    rows = np.arange(len(state["candidate"]))
    fits = all(
        column.shape == rows.shape and column.dtype == _ENTRY[name]
        for name, column in state.items()
    )
    if not fits or (state["candidate"] >= rows).any() or (state["confirmed"] > rows).any():
        raise ValueError(f"{path} is damaged: its columns do not fit")
    return state
