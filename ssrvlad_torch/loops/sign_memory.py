"""Signs of the frames of a live stream so far, and the scores of a new frame against them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..recognition.signs import REACH, moved, numbers, products
from .memory import Floats, GrowingArray

Signs = npt.NDArray[np.uint8]

_STEPS = range(-REACH, REACH + 1)
_LEAST = 1e-3


class SignVectors:
    """Signs of the frames of a stream by one method, in order.

    Scores are those of `recognition.signs` without the mean of all frames so far, the new one among
    them. The products of each frame with that mean are sums of products of frames, which are whole
    numbers: a new frame adds its own.

    Args:
        shape: columns, rows and bytes of the signs of a frame.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        whole = torch.full((1, *shape), 255, dtype=torch.uint8)
        self._masks = torch.cat([moved(whole, step) for step in _STEPS])
        self._kept = self._masks.flatten(2).any(2).double()
        self._signs = GrowingArray(np.uint8, *shape)
        self._total = torch.zeros(shape[0], 8 * shape[1] * shape[2], dtype=torch.double)
        self._with_frames = GrowingArray(np.float64, len(_STEPS))
        self._with_moved = GrowingArray(np.float64, len(_STEPS))

    def __len__(self) -> int:
        return len(self._signs.values)

    def checked(self, signs: Tensor, frame: str) -> Signs:
        """The signs of a frame, ``(1, *shape)``; another shape or dtype is a ValueError."""
        shape = self._signs.values.shape[1:]
        if signs.shape != shape or signs.dtype != torch.uint8:
            got = f"{tuple(signs.shape)} {signs.dtype}"
            raise ValueError(f"frame {frame!r}: expected signs {shape} uint8, got {got}")
        return signs.numpy(force=True)[None]

    def add(self, frame: Signs) -> None:
        """Appends a frame by its signs."""
        signs = torch.from_numpy(frame)
        frames, others = self._products(signs)
        self._with_frames.values[:] += frames
        self._with_moved.values[:] += others
        own, again = (each[0] for each in _products(signs, signs[None], self._masks))
        self._with_frames.append(frames.sum(0) + own)
        self._with_moved.append(others[:, ::-1].sum(0) + again)
        self._signs.append(frame)
        self._total += _numbers(signs)

    def extend(self, signs: Tensor) -> None:
        """Appends frames to an empty memory."""
        for part in signs:
            self._signs.append(part.numpy())
            self._total += _numbers(part)
        means = [each * self._total for each in self._kept[:, :, None]]
        shifts = [moved(self._total[None], step)[0] for step in _STEPS]
        flat = torch.stack([*means, *shifts]).flatten(1)
        for part in signs:
            sums = (flat @ _numbers(part).flatten()).numpy()
            self._with_frames.append(sums[: len(_STEPS)])
            self._with_moved.append(sums[len(_STEPS) :])

    def descriptors(self, first: int, last: int) -> Signs:
        """``(last - first, columns, rows, bytes)``, a copy."""
        return self._signs.values[first:last].copy()

    def scores(self, swept: Signs) -> Floats:
        """``(N,)`` float32 cosines of a new frame ``(1, *shape)`` to all others, each for its best
        move."""
        signs = torch.from_numpy(swept[0])
        frames, others = self._products(signs)
        count, new = len(self) + 1, _numbers(signs)
        mean = (self._total + new) / count
        best = np.full(len(self), -np.inf)
        for place, step in enumerate(_STEPS):
            kept = self._kept[place][:, None] * mean
            query, off = (moved(each[None], step)[0] for each in (new, mean))
            with_frames = self._with_frames.values[:, place] + frames[:, place]
            with_moved = self._with_moved.values[:, place] + others[:, place]
            counted = float(self._kept[place].sum()) * new.shape[1]
            rows = counted - 2 * with_frames / count + float(kept.square().sum())
            score = others[:, place] - with_moved / count + float(((off - query) * kept).sum())
            length = float((query - off).norm())
            best = np.maximum(best, score / np.maximum(length * np.sqrt(rows.clip(0)), _LEAST))
        scores: Floats = best.clip(max=1).astype(np.float32)
        return scores

    def _products(self, signs: Tensor) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        return _products(signs, torch.from_numpy(self._signs.values), self._masks)


def _numbers(signs: Tensor) -> Tensor:
    """``(columns, D)`` float64, the numbers 1 and -1 of a frame."""
    return numbers(signs).flatten(1).double()


def _products(
    signs: Tensor, rows: Tensor, masks: Tensor
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """``(N, S)`` products of the signs of a frame with rows, over the columns that are left after
    each of S moves: where they are, and moved."""
    queries = [signs[None]] * len(masks) + [moved(signs[None], step) for step in _STEPS]
    packed = (torch.cat(queries), torch.cat((masks, masks)), rows)
    both = products(*(each.flatten(1) for each in packed)).long().numpy().T
    return both[:, : len(masks)], both[:, len(masks) :]
