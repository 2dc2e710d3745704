"""Signs of the frames of a live stream so far, and the scores of a new frame against them."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .live_vectors import BEFORE, Floats, GrowingArray
from .signs import REACH, moved, numbers, products

Signs = npt.NDArray[np.uint8]

_STEPS = range(-REACH, REACH + 1)
_LEAST = 1e-3
_FRAMES_AT_ONCE = 256


class LiveSigns:
    """Signs of the frames of a stream by one method, in order; ``shape`` is columns, rows and
    bytes.

    Scores are those of `channels.signs`, each frame without the mean of its sequence as in
    `LiveVectors`. Products with the running mean are kept as sums of whole numbers, so a new
    frame is one addition.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        whole = torch.full((1, *shape), 255, dtype=torch.uint8)
        self._masks = torch.cat([moved(whole, step) for step in _STEPS])
        self._kept = self._masks.flatten(2).any(2).double()
        self._signs = GrowingArray(np.uint8, *shape)
        self._total = torch.zeros(shape[0], 8 * shape[1] * shape[2], dtype=torch.double)
        self._before, self._before_frames = torch.zeros_like(self._total), 0
        self._means, self._frames = list[Tensor](), list[int]()
        self._lengths = GrowingArray(np.float64, len(_STEPS))
        self._with_sum = GrowingArray(np.float64, 2, len(_STEPS))

    def __len__(self) -> int:
        return len(self._signs.values)

    @property
    def empty(self) -> npt.NDArray[np.bool_]:
        """See `Live`; of no frame is nothing known."""
        return np.zeros(len(self), np.bool_)

    def checked(self, signs: Tensor, frame: str) -> Signs:
        """The signs of a frame, ``(1, *shape)``; another shape or dtype is a ValueError."""
        shape = self._signs.values.shape[1:]
        if signs.shape != shape or signs.dtype != torch.uint8:
            got = f"{tuple(signs.shape)} {signs.dtype}"
            raise ValueError(f"frame {frame!r}: expected signs {shape} uint8, got {got}")
        return signs.numpy(force=True)[None]

    def start_sequence(self) -> None:
        """The next frame starts another sequence: the mean of the present one stays as it is."""
        first, signs = len(self._lengths.values), self._signs.values
        if first == len(self):
            return
        total, count = self._sum()
        mean = total / count
        for with_mean in self._products_with(self._kept[:, :, None] * mean, first):
            self._lengths.append(self._row_lengths(with_mean, mean))
        self._means.append(mean)
        self._frames.append(len(signs) - first)
        self._before += self._total
        self._before_frames = len(signs)
        self._total = torch.zeros_like(self._total)
        self._with_sum = GrowingArray(np.float64, 2, len(_STEPS))

    def add(self, frame: Signs) -> None:
        """Appends a frame by its signs."""
        self._recount()
        signs = torch.from_numpy(frame)
        self._with_sum.values[:] += self._products(signs)
        self._signs.append(frame)
        self._total += _numbers(signs)
        self._recount()

    def extend(self, signs: Tensor) -> None:
        """Appends frames of a sequence by their signs ``(N, *shape)``."""
        for part in signs:
            self._signs.append(part.numpy())
            self._total += _numbers(part)
        self._with_sum = GrowingArray(np.float64, 2, len(_STEPS))

    def descriptors(self, first: int, last: int) -> Signs:
        """``(last - first, columns, rows, bytes)``, a copy."""
        return self._signs.values[first:last].copy()

    def scores(self, swept: Signs) -> Floats:
        """``(N,)`` float32 best cosines of a new frame ``(1, *shape)`` to all others."""
        self._recount()
        signs, first = torch.from_numpy(swept[0]), len(self._lengths.values)
        with_others, new = self._products(signs), _numbers(signs)
        total, count = self._sum()
        mean, count = (total + new) / (count + 1), count + 1
        with_mean = (self._with_sum.values + with_others) / count
        own = self._row_lengths(with_mean[first:, 0], mean)
        rows = np.concatenate((self._lengths.values, own))
        best = np.full(len(self), -np.inf)
        for place, step in enumerate(_STEPS):
            query = moved((new - mean)[None], step)[0]
            cosines = with_others[:, 1, place] - with_mean[:, 1, place]
            of_means = [float((query * each).sum()) for each in (*self._means, mean)]
            cosines -= np.repeat(of_means, (*self._frames, len(self) - first))
            cosines /= np.maximum(float(query.norm()) * rows[:, place], _LEAST)
            best = np.maximum(best, cosines)
        scores: Floats = best.clip(max=1).astype(np.float32)
        return scores

    def _sum(self) -> tuple[Tensor, int]:
        """The sum of which the mean of the present sequence is a fraction, and of how many."""
        count = len(self) - len(self._lengths.values)
        if not self._before_frames:
            return self._total, count
        return self._total + self._before * (BEFORE / self._before_frames), count + BEFORE

    def _row_lengths(self, with_mean: npt.NDArray[np.float64], mean: Tensor) -> Any:
        """``(..., S)`` lengths of rows without the mean, by their products with it."""
        kept = self._kept[:, :, None]
        counted = (kept.sum((1, 2)) * mean.shape[1] + (kept * mean.square()).sum((1, 2))).numpy()
        return np.sqrt((counted - 2 * with_mean).clip(0))

    def _products_with(self, vectors: Tensor, first: int) -> npt.NDArray[np.float64]:
        """``(N, V)`` products of the frames from the first on with ``(V, columns, D)``."""
        flat = vectors.flatten(1)
        parts = torch.from_numpy(self._signs.values[first:]).split(_FRAMES_AT_ONCE)
        found = [flat.new_zeros(0, len(flat))]
        found += [numbers(part).flatten(1).double() @ flat.T for part in parts]
        return torch.cat(found).numpy()

    def _recount(self) -> None:
        """Adds the products of the last frames with the sum of the present sequence: of a new one,
        or of all after a sequence started or frames were loaded."""
        counted = len(self._with_sum.values)
        if counted == len(self):
            return
        total, _ = self._sum()
        shifts = torch.cat([moved(total[None], step) for step in _STEPS])
        vectors = torch.cat((self._kept[:, :, None] * total, shifts))
        for row in self._products_with(vectors, counted):
            self._with_sum.append(row.reshape(2, -1))

    def _products(self, signs: Tensor) -> npt.NDArray[np.int64]:
        """``(N, 2, S)`` products of a frame with all others, over the columns that are left after
        each of S moves: where they are, and moved."""
        queries = [signs[None]] * len(_STEPS) + [moved(signs[None], step) for step in _STEPS]
        masks, rows = torch.cat([self._masks] * 2), torch.from_numpy(self._signs.values)
        packed = (each.flatten(1) for each in (torch.cat(queries), masks, rows))
        both: npt.NDArray[np.int64] = products(*packed).long().numpy().T
        return both.reshape(-1, 2, len(_STEPS))


def _numbers(signs: Tensor) -> Tensor:
    """``(columns, D)`` float64, the numbers 1 and -1 of a frame."""
    return numbers(signs).flatten(1).double()
