"""The frames of a stream so far, and the scores of a new frame against them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .scores import REACH, differing

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

BLOCK_ROWS = 1024
"""Rows of a block of the map."""
BEFORE = 10
"""How many frames the mean of all earlier sequences counts in that of a sequence."""

_ROUNDING = 1e-6
_MIN_LENGTH = 1e-9**0.5
_LEAST = 1e-3
_MOVES = range(-REACH, REACH + 1)
_ROWS_AT_ONCE = 64


class Map:
    """Descriptors of the frames so far; each sequence has its own mean, the present one that of its
    frames so far."""

    def __init__(self) -> None:
        self.rows = 0
        self.empty = np.empty(0, np.bool_)
        self._blocks: list[Floats] = []
        self._total, self._before = np.zeros(1), np.zeros(1)
        self._counted = self._counted_before = 0
        self._means, self._frames = list[Floats](), list[int]()
        self._lengths = np.empty(0, np.float32)

    def append(self, descriptor: Floats) -> None:
        """Appends the next frame of the stream."""
        block, place = divmod(self.rows, BLOCK_ROWS)
        if place == 0:
            self._blocks.append(np.zeros((BLOCK_ROWS, len(descriptor)), np.float32))
        self._blocks[block][place] = descriptor
        self._total, self._counted = self._total + descriptor, self._counted + descriptor.any()
        self.empty = np.append(self.empty, not descriptor.any())
        self.rows += 1

    def start_sequence(self) -> None:
        """The next frame starts another sequence: the mean of the present one stays as it is."""
        first = len(self._lengths)
        if first == self.rows:
            return
        mean = self._mean(np.zeros(1), 0)
        blocks = [
            np.linalg.norm(block - mean, axis=1) for block in self._blocks[first // BLOCK_ROWS :]
        ]
        skip = first % BLOCK_ROWS
        fresh = np.concatenate(blocks)[skip : skip + self.rows - first]
        self._lengths = np.append(self._lengths, np.maximum(fresh, np.float32(_MIN_LENGTH)))
        self._means.append(mean)
        self._frames.append(self.rows - first)
        self._before = self._before + self._total
        self._counted_before += self._counted
        self._total, self._counted = np.zeros(1), 0

    def _mean(self, descriptor: Floats, counted: int) -> Floats:
        """``(D,)``, the mean of the present sequence with another frame."""
        total, counted = self._total + descriptor, self._counted + counted
        if self._counted_before:
            total, counted = (
                total + self._before * (BEFORE / self._counted_before),
                counted + BEFORE,
            )
        mean: Floats = (total / max(1, counted)).astype(np.float32)
        return mean

    def scores(self, swept: Floats) -> Floats:
        """``(rows,)`` cosines of a new frame's best anchor, each frame without the mean of its
        sequence; -inf for an empty frame."""
        mean, first = self._mean(swept[len(swept) // 2], 1), len(self._lengths)
        centred = swept - mean
        centred[np.abs(centred).max(axis=1) <= _ROUNDING] = 0
        centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), _ROUNDING)
        columns = np.concatenate((centred, mean[None]))
        products = np.concatenate([columns @ block.T for block in self._blocks], axis=1)
        products = products[:, : self.rows]
        square = 1 - 2 * products[-1, first:] + mean @ mean
        lengths = np.append(self._lengths, np.sqrt(np.maximum(square, _MIN_LENGTH**2)))
        offsets = centred @ np.stack([*self._means, mean]).T
        products = products[:-1] - np.repeat(offsets, [*self._frames, self.rows - first], axis=1)
        scores: Floats = (products.max(axis=0) / lengths).astype(np.float32)
        scores[self.empty] = -np.inf
        return scores


class SignMap:
    """Features of the frames so far: the numbers 1 and -1, without the mean of their sequence as in
    `Map`; see `ssrvlad_torch.loops.sign_memory`.

    Sums of products with frames are whole numbers: a new frame adds its own to those with the mean
    of the present sequence.

    Args:
        shape: of the features of a frame, columns, rows and bytes.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        columns, self._length = shape[0], 8 * shape[1] * shape[2]
        source = np.arange(columns) - np.array(_MOVES)[:, None]
        self._kept = ((source >= 0) & (source < columns)).astype(float)
        self._signs = Rows(np.empty((1, *shape), np.uint8))
        self._total, self._before = np.zeros((2, columns, self._length))
        self._counted_before = 0
        self._means, self._frames = list[Array](), list[int]()
        self._lengths, self._with_total, self._with_moved = (
            Rows(np.empty((1, len(_MOVES)))) for _ in range(3)
        )

    def products(self, signs: Array) -> tuple[Array, Array]:
        """``(rows, M)`` products of a frame with all rows, over the columns that are left after
        each of M moves: where they are, and moved."""
        rows, columns = self._signs.values, len(signs)
        most = self._length * self._kept.sum(1)
        there = most - 2 * differing(signs, rows) @ self._kept.T
        moved = np.empty_like(there)
        for number, move in enumerate(_MOVES):
            ours = signs[max(0, -move) : columns - max(0, move)]
            theirs = rows[:, max(0, move) : columns - max(0, -move)]
            moved[:, number] = most[number] - 2 * differing(ours, theirs).sum(1)
        return there, moved

    def append(self, signs: Array, products: tuple[Array, Array]) -> None:
        """Appends the next frame of the stream, by its signs and their products."""
        there, moved = products
        self._with_total.values[:] += there[len(self._lengths.values) :]
        self._with_moved.values[:] += moved
        self._signs.append(signs)
        self._total += _numbers(signs)
        [with_total], [with_moved] = self._with_sum(len(self._signs.values) - 1)
        self._with_total.append(with_total)
        self._with_moved.append(with_moved)

    def start_sequence(self) -> None:
        """The next frame starts another sequence: the mean of the present one stays as it is."""
        first, rows = len(self._lengths.values), len(self._signs.values)
        if first == rows:
            return
        total, count = self._sum()
        for length in self._lengths_of(self._with_total.values / count, total / count):
            self._lengths.append(length)
        self._means.append(total / count)
        self._frames.append(rows - first)
        self._before += self._total
        self._counted_before = rows
        self._total = np.zeros_like(self._total)
        self._with_total = Rows(np.empty((1, len(_MOVES))))
        self._with_moved.values[:] = self._with_sum(0)[1]

    def scores(self, signs: Array, products: tuple[Array, Array]) -> Floats:
        """``(rows,)`` cosines of a new frame, each for its best move, by its signs and their
        products."""
        first, (there, moved) = len(self._lengths.values), products
        new, (total, count) = _numbers(signs), self._sum()
        count += 1
        mean = (total + new) / count
        own = self._lengths_of((self._with_total.values + there[first:]) / count, mean)
        lengths = np.concatenate((self._lengths.values, own))
        with_new = moved - (self._with_moved.values + moved) / count
        frames = [*self._frames, len(lengths) - first]
        best = np.full(len(lengths), -np.inf)
        for number, move in enumerate(_MOVES):
            query = _moved(new - mean, move)
            of_means = [float((query * each).sum()) for each in (*self._means, mean)]
            score = with_new[:, number] - np.repeat(of_means, frames)
            score /= np.maximum(np.linalg.norm(query) * lengths[:, number], _LEAST)
            best = np.maximum(best, score)
        scores: Floats = np.minimum(best, 1).astype(np.float32)
        return scores

    def _sum(self) -> tuple[Array, int]:
        """The sum of which the mean of the present sequence is a fraction, and of how many."""
        count = len(self._signs.values) - len(self._lengths.values)
        if not self._counted_before:
            return self._total, count
        return self._total + self._before * (BEFORE / self._counted_before), count + BEFORE

    def _lengths_of(self, with_mean: Array, mean: Array) -> Array:
        """``(rows, M)`` lengths of rows without the mean, by their products with it."""
        most = self._kept @ (self._length + np.square(mean).sum(1))
        lengths: Array = np.sqrt(np.maximum(most - 2 * with_mean, 0))
        return lengths

    def _with_sum(self, first: int) -> tuple[Array, Array]:
        """``(rows, M)`` products of the rows from the first on with the sum of the sequence, over
        the columns that are left after each move: where they are, and moved."""
        total, _ = self._sum()
        vectors = [kept[:, None] * total for kept in self._kept]
        vectors += [_moved(total, move) for move in _MOVES]
        flat, rows = np.stack(vectors).reshape(len(vectors), -1), self._signs.values
        products = np.empty((len(rows) - first, len(vectors)))
        for row in range(first, len(rows), _ROWS_AT_ONCE):
            numbers = _numbers(rows[row : row + _ROWS_AT_ONCE])
            part = slice(row - first, row - first + len(numbers))
            products[part] = numbers.reshape(len(numbers), -1) @ flat.T
        return products[:, : len(_MOVES)], products[:, len(_MOVES) :]


class Rows:
    """Rows of an array; its capacity doubles, so that appending copies little.

    Args:
        buffer: ``(1, ...)``, room for the first row.
    """

    def __init__(self, buffer: Array) -> None:
        self._buffer, self._rows = buffer, 0

    @property
    def values(self) -> Array:
        """A view of the rows so far."""
        return self._buffer[: self._rows]

    def append(self, row: Array) -> None:
        """Appends a row."""
        if self._rows == len(self._buffer):
            self._buffer = np.concatenate((self._buffer, np.empty_like(self._buffer)))
        self._buffer[self._rows] = row
        self._rows += 1


def _numbers(signs: Array) -> Array:
    """``(..., columns, D)`` float64, signs ``(..., columns, rows, bytes)`` as 1 and -1."""
    bits = np.unpackbits(signs, axis=-1, bitorder="little")
    return bits.reshape(*bits.shape[:-2], -1).astype(float) * 2 - 1


def _moved(grid: Array, columns: int) -> Array:
    """``(columns, D)`` moved to the right, or to the left; zero comes in from outside."""
    after, kept = np.zeros_like(grid), len(grid) - abs(columns)
    after[max(0, columns) :][:kept] = grid[max(0, -columns) :][:kept]
    return after
