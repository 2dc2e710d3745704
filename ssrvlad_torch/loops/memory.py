"""The frames of a live stream so far, and the scores of a new frame against them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

BLOCK_ROWS = 1024
"""Rows of a block; blocks never move, so growing copies no descriptor."""

Floats = npt.NDArray[np.float32]

_ROUNDING = 1e-6
"""A vector this near to the mean equals it; see `recognition.standardise`."""
_MIN_SQUARE = 1e-9
_LENGTH_TOLERANCE = 1e-3


class GrowingArray:
    """Rows of any dtype and shape; its capacity doubles, so appending a row costs O(1)."""

    def __init__(self, dtype: npt.DTypeLike, *shape: int) -> None:
        self._buffer: npt.NDArray[Any] = np.empty((1, *shape), dtype)
        self._rows = 0

    @property
    def values(self) -> npt.NDArray[Any]:
        """A view of the rows so far."""
        return self._buffer[: self._rows]

    def append(self, row: object) -> None:
        """Appends a row."""
        if self._rows == len(self._buffer):
            wider = np.empty((2 * self._rows, *self._buffer.shape[1:]), self._buffer.dtype)
            wider[: self._rows] = self._buffer
            self._buffer = wider
        self._buffer[self._rows] = row
        self._rows += 1


class Vectors:
    """Descriptors of the frames of a stream by one method, in order.

    Args:
        length: D, the number of values in a descriptor.
    """

    def __init__(self, length: int) -> None:
        self._blocks = [np.empty((BLOCK_ROWS, length), np.float32)]
        self._empty = GrowingArray(np.bool_)
        self._total = np.zeros(length)
        self._counted = 0

    def __len__(self) -> int:
        return len(self.empty)

    @property
    def empty(self) -> npt.NDArray[np.bool_]:
        """``(N,)``, whether the descriptor of each frame is zero; a view."""
        return self._empty.values

    def checked(self, descriptor: Tensor, frame: str) -> Floats:
        """See `checked_vectors`."""
        return checked_vectors(descriptor, frame, len(self._total))

    def add(self, descriptor: Floats) -> None:
        """Appends a frame by its ``(D,)`` descriptor of length 1 or zero."""
        block, place = divmod(len(self), len(self._blocks[0]))
        if block == len(self._blocks):
            self._blocks.append(np.empty_like(self._blocks[0]))
        self._blocks[block][place] = descriptor
        empty = not descriptor.any()
        self._empty.append(empty)
        self._total += descriptor
        self._counted += not empty

    def extend(self, descriptors: Tensor) -> None:
        """Appends frames by their descriptors ``(N, D)``."""
        for descriptor in descriptors.numpy():
            self.add(descriptor)

    def descriptors(self, first: int, last: int) -> Floats:
        """``(last - first, D)`` float32, a copy."""
        places = (divmod(row, len(self._blocks[0])) for row in range(first, last))
        rows = [self._blocks[block][place] for block, place in places]
        return np.array(rows, np.float32).reshape(-1, len(self._total))

    def scores(self, swept: Floats) -> Floats:
        """``(N,)`` float32 cosines of a new frame to all others, standardised by the mean of all
        frames with the new one; -inf for an empty frame. ``swept`` ``(S, D)`` are its descriptors
        from S anchors, the usual one in the middle; the best anchor counts."""
        mean = (self._total + swept[len(swept) // 2]) / (self._counted + 1)
        mean = mean.astype(np.float32)
        centred = swept - mean
        centred[np.abs(centred).max(axis=1) <= _ROUNDING] = 0
        centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _ROUNDING)
        columns = np.concatenate((centred, mean[None])).T
        products = np.empty((len(self), columns.shape[1]), np.float32)
        for first, block in enumerate(self._blocks):
            part = products[first * len(block) : (first + 1) * len(block)]
            np.dot(block[: len(part)], columns, out=part)
        lengths = np.sqrt(np.maximum(1 - 2 * products[:, -1] + mean @ mean, _MIN_SQUARE))
        scores: Floats = (products[:, :-1] - centred @ mean).max(axis=1) / lengths
        scores[self.empty] = -np.inf
        return scores


class Memory(Vectors):
    """Ids, poses and descriptors of the frames of a stream."""

    def __init__(self, length: int) -> None:
        super().__init__(length)
        self.rows: dict[str, int] = {}
        self.frames: list[str] = []
        self._poses = GrowingArray(np.float64, 3)

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` x and y in metres, heading in radians, NaN where unknown; a view."""
        return self._poses.values

    def append(self, frame: str, pose: Sequence[float], descriptor: Floats) -> None:
        """Appends a frame by its ``(D,)`` descriptor of length 1 or zero."""
        self.rows[frame] = len(self)
        self.frames.append(frame)
        self._poses.append(pose)
        self.add(descriptor)


def checked_vectors(descriptor: Tensor, frame: str, length: int) -> Floats:
    """``(S, D)`` descriptors of a frame, from ``(D,)`` or ``(S, D)``; another shape and a length
    other than 1 or 0 are a ValueError."""
    vectors: Floats = np.atleast_2d(descriptor.detach().cpu().float().numpy()).copy()
    if vectors.ndim != 2 or vectors.shape[1] != length or not len(vectors) % 2:
        raise ValueError(
            f"frame {frame!r}: expected a descriptor ({length},), or of an odd number of "
            f"anchors, got {tuple(descriptor.shape)}"
        )
    lengths = np.linalg.norm(vectors, axis=1)
    if not ((np.abs(lengths - 1) <= _LENGTH_TOLERANCE) | (lengths == 0)).all():
        raise ValueError(
            f"frame {frame!r}: expected a descriptor of length 1 or zero, got {lengths.max():g}"
        )
    return vectors
