"""The map of a live stream: reference descriptors after Eq. 3, which grows frame by frame."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from ..recognition.matching import temporal_sum

BLOCK_ROWS = 1024
"""Rows that are made room for at once; a block never moves, so growing copies no descriptor."""

Floats = npt.NDArray[np.float32]


class GrowingArray:
    """Rows of any dtype, one after another; the room for them doubles, so a row costs O(1)."""

    def __init__(self, dtype: npt.DTypeLike) -> None:
        self._room: npt.NDArray[Any] = np.empty(1, dtype)
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    @property
    def values(self) -> npt.NDArray[Any]:
        """The rows, in place; later ones do not show in it."""
        return self._room[: self._rows]

    def append(self, row: object) -> None:
        """Adds a row."""
        if self._rows == len(self._room):
            wider = np.empty(2 * self._rows, self._room.dtype)
            wider[: self._rows] = self._room
            self._room = wider
        self._room[self._rows] = row
        self._rows += 1


@dataclass(frozen=True)
class Snapshot:
    """The map as it was at one moment. It stays as it is while the map grows.

    Attributes:
        blocks: ``(BLOCK_ROWS, D)`` float32 each, one or more; descriptors of length 1 or zero, of
            which those from ``rows`` on are not of this snapshot.
        empty: ``(rows,)`` bool, frames whose own descriptor is zero; they match nothing.
        ids: ids of the frames; those from ``rows`` on are not of this snapshot.
        rows: number of frames.
    """

    blocks: tuple[Floats, ...]
    empty: npt.NDArray[np.bool_]
    ids: Sequence[str]
    rows: int

    @property
    def frames(self) -> list[str]:
        """Ids of the frames in order."""
        return list(self.ids[: self.rows])

    @property
    def descriptors(self) -> Floats:
        """``(rows, D)`` float32, a copy."""
        return np.concatenate(self.blocks)[: self.rows]

    def scores(self, query: Floats) -> Floats:
        """Cosines (Eq. 4) of one query to every frame.

        Args:
            query: ``(D,)`` float32 of length 1.

        Returns:
            ``(rows,)`` float32, -inf for an empty frame.
        """
        scores = np.empty(self.rows, np.float32)
        begin = 0
        for block in self.blocks:
            part = scores[begin : begin + len(block)]
            np.dot(block[: len(part)], query, out=part)
            begin += len(block)
        scores[self.empty] = -np.inf
        return scores

    def search(self, query: Floats, top: int = 5) -> list[tuple[str, float]]:
        """The frames with the highest scores, best first, the earlier of equals.

        Args:
            query: ``(D,)`` float32 of length 1.
            top: number of frames, at least 1.

        Returns:
            ids and scores; empty frames are not among them.
        """
        scores = self.scores(query)
        best = np.argsort(-scores, kind="stable")[:top].tolist()
        return [(self.ids[row], float(scores[row])) for row in best if not self.empty[row]]


class OnlineMemory:
    """Descriptors of a stream, summed over time (Eq. 3) as frames arrive.

    A frame enters the map when the t frames after it are known, or its sequence has ended: the
    map is t frames late, and a row never changes once it is there. Its rows are, bit by bit, the
    first rows of what `matching.temporal_sum` makes of all frames.

    One thread may write while others read: a reader takes `snapshot` and needs no lock.

    Args:
        length: D, numbers in a descriptor.
        reach: t of Eq. 3, 0 for none.

    Attributes:
        snapshot: the map of now; replaced, never changed.
    """

    def __init__(self, length: int, reach: int) -> None:
        self.reach = reach
        self._ids: list[str] = []
        self._blocks: tuple[Floats, ...] = (np.empty((BLOCK_ROWS, length), np.float32),)
        self._empty = GrowingArray(np.bool_)
        self._window: deque[Floats] = deque(maxlen=2 * reach + 1)
        self._waiting = 0
        self._sequence: str | None = None
        self.snapshot = Snapshot(self._blocks, self._empty.values, self._ids, 0)

    @classmethod
    def of_frames(cls, frames: Sequence[str], descriptors: Floats, reach: int) -> OnlineMemory:
        """The memory that these frames leave, one `append` after another, made in one go.

        Args:
            frames: N ids in the order of the stream.
            descriptors: ``(N, D)`` float32, raw.
            reach: t of Eq. 3.
        """
        memory = cls(descriptors.shape[1], reach)
        if not frames:
            return memory
        sequences = [frame.rpartition("/")[0] for frame in frames]
        changes = [here != before for before, here in itertools.pairwise(sequences)]
        drives = list(itertools.accumulate(changes, initial=0))
        last = len(frames) - drives.index(drives[-1])
        memory._sequence = sequences[-1]
        memory._ids += frames
        memory._waiting = min(last, reach)
        memory._window += list(descriptors[-min(last, 2 * reach + 1) :])
        summed = temporal_sum(descriptors, list(map(str, drives)), reach)
        memory._put(summed[: len(frames) - memory._waiting].numpy())
        return memory

    def __len__(self) -> int:
        return len(self._ids)

    def append(self, frame: str, descriptor: Floats) -> None:
        """Adds the next frame of the stream.

        Args:
            frame: id, ``<sequence>/<name>``; another sequence ends the one before.
            descriptor: ``(D,)`` float32, raw.
        """
        sequence = frame.rpartition("/")[0]
        if sequence != self._sequence:
            self.end_sequence()
        self._sequence = sequence
        self._ids.append(frame)
        self._window.append(descriptor)
        self._waiting += 1
        if self._waiting > self.reach:
            self._publish(1)

    def end_sequence(self) -> None:
        """Takes in the frames that wait for later ones: there will be none."""
        if self._waiting:
            self._publish(self._waiting)
        self._window.clear()
        self._sequence = None

    def _publish(self, count: int) -> None:
        """Takes in so many of the waiting frames, the oldest first."""
        first = len(self._window) - self._waiting
        self._waiting -= count
        self._put(np.stack([self._sum_around(first + number) for number in range(count)]))

    def _sum_around(self, place: int) -> Floats:
        """Eq. 3 for a frame of the window; added in the order of `temporal_sum`, no bit differs."""
        total = np.zeros_like(self._window[place])
        for descriptor in list(self._window)[max(0, place - self.reach) : place + self.reach + 1]:
            total += descriptor
        total *= self._window[place].any()
        return F.normalize(torch.from_numpy(total)[None], dim=1)[0].numpy()

    def _put(self, rows: Floats) -> None:
        for row in rows:
            block, place = divmod(len(self._empty), len(self._blocks[0]))
            if block == len(self._blocks):
                self._blocks += (np.empty_like(self._blocks[0]),)
            self._blocks[block][place] = row
            self._empty.append(not row.any())
        count = len(self._empty)
        self.snapshot = Snapshot(self._blocks, self._empty.values, self._ids, count)
