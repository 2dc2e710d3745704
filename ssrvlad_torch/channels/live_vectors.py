"""Vectors of the frames of a live stream so far, and the scores of a new frame against them."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

BLOCK_ROWS = 1024
"""Rows of a block; blocks never move, so growing copies no descriptor."""

Floats = npt.NDArray[np.float32]

_ROUNDING = 1e-6
"""A vector this near to the mean equals it; see `recognition.standardise`."""
_MIN_SQUARE = 1e-9
_LENGTH_TOLERANCE = 1e-3

BEFORE = 10
"""A new sequence's mean starts as the mean of all earlier sequences, weighted as this number of
frames: what its own first frames have in common is their place."""


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


class LiveVectors:
    """Descriptors, of ``length`` values, of the frames of a stream by one method, in order. Each
    sequence has its own mean, see `recognition.standardise`. The present one's is that of its
    frames so far; `BEFORE` frames of the mean of all earlier sequences count in it."""

    def __init__(self, length: int) -> None:
        self._blocks = [np.empty((BLOCK_ROWS, length), np.float32)]
        self._empty = GrowingArray(np.bool_)
        self._total, self._counted = np.zeros(length), 0
        self._before, self._counted_before = np.zeros(length), 0
        self._finished, self._frames = list[Floats](), list[int]()
        self._scales = GrowingArray(np.float32)

    def __len__(self) -> int:
        return len(self.empty)

    @property
    def empty(self) -> npt.NDArray[np.bool_]:
        """``(N,)``, whether the descriptor of each frame is zero; a view."""
        return self._empty.values

    def checked(self, descriptor: Tensor, frame: str) -> Floats:
        """``(S, D)`` descriptors of a frame, from ``(D,)`` or ``(S, D)``; another shape and a
        length other than 1 or 0 are a ValueError."""
        vectors: Floats = np.atleast_2d(descriptor.detach().cpu().float().numpy()).copy()
        if vectors.ndim != 2 or vectors.shape[1] != len(self._total) or not len(vectors) % 2:
            raise ValueError(
                f"frame {frame!r}: expected a descriptor ({len(self._total)},), or of an odd "
                f"number of anchors, got {tuple(descriptor.shape)}"
            )
        lengths = np.linalg.norm(vectors, axis=1)
        if not ((np.abs(lengths - 1) <= _LENGTH_TOLERANCE) | (lengths == 0)).all():
            raise ValueError(
                f"frame {frame!r}: expected a descriptor of length 1 or zero, got {lengths.max():g}"
            )
        return vectors

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

    def start_sequence(self) -> None:
        """The next frame starts another sequence: the mean of the present one stays as it is."""
        first = len(self._scales.values)
        if first == len(self):
            return
        mean = self._mean(np.zeros_like(self._total), 0)
        for row in range(first, len(self), BLOCK_ROWS):
            vectors = self.descriptors(row, min(row + BLOCK_ROWS, len(self)))
            lengths = np.linalg.norm(vectors - mean, axis=1)
            for scale in 1 / np.maximum(lengths, math.sqrt(_MIN_SQUARE)):
                self._scales.append(scale)
        self._finished.append(mean)
        self._frames.append(len(self) - first)
        self._before += self._total
        self._counted_before += self._counted
        self._total, self._counted = np.zeros_like(self._total), 0

    def _mean(self, descriptor: Floats, counted: int) -> Floats:
        """``(D,)`` float32, the mean of the present sequence with another frame."""
        total, counted = self._total + descriptor, self._counted + counted
        if self._counted_before:
            total = total + self._before * (BEFORE / self._counted_before)
            counted += BEFORE
        mean: Floats = (total / max(1, counted)).astype(np.float32)
        return mean

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
        """``(N,)`` float32 cosines of a new frame to all others, each without the mean of its
        sequence; -inf for an empty frame. ``swept`` ``(S, D)`` are its descriptors from S anchors,
        the usual one in the middle; the best anchor counts."""
        centre = swept[len(swept) // 2]
        mean, first = self._mean(centre, int(centre.any())), len(self._scales.values)
        centred = swept - mean
        centred[np.abs(centred).max(axis=1) <= _ROUNDING] = 0
        centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _ROUNDING)
        columns = np.concatenate((centred, mean[None]))
        products = np.empty((len(columns), len(self)), np.float32)
        for number, block in enumerate(self._blocks):
            part = slice(number * len(block), min((number + 1) * len(block), len(self)))
            rows = torch.from_numpy(block[: part.stop - part.start])
            products[:, part] = torch.from_numpy(columns) @ rows.T
        own = products[:-1, first:]
        own -= (centred @ mean)[:, None]
        own /= np.sqrt(np.maximum(1 - 2 * products[-1, first:] + mean @ mean, _MIN_SQUARE))
        if first:
            offsets = centred @ np.stack(self._finished).T
            products[:-1, :first] -= np.repeat(offsets, self._frames, axis=1)
            products[:-1, :first] *= self._scales.values
        scores: Floats = products[:-1].max(axis=0)
        scores[self.empty] = -np.inf
        return scores
