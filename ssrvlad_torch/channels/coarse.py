"""Coarse forms: descriptors in few bytes, so that a query is compared with all rows of a large map.

Of signs, two bytes of each cell, and two more for the best rows. Of vectors, `LENGTH`
small numbers along the directions in which the rows of a map differ most (principal components).
Scores are near those of the channel; the best of them are candidates, which are then scored
exactly. Not in the paper.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Protocol, Self

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from ..native import core
from ..native.addresses import address
from . import Column
from .signs import REACH, moved, numbers

Codes = npt.NDArray[np.uint8] | npt.NDArray[np.int8]
Learnt = Mapping[str, npt.NDArray[np.float32]]

LENGTH, LANES = 64, 64
"""Numbers of a vector, and rows of a block."""

_BYTES, _WORD = 2, 8
"""Bytes of a cell in a layer of codes, and of a machine word."""
_MOST = 127
_DEVIATIONS = 4.0
_ROWS_AT_ONCE = 1 << 12


class Coarse(Protocol):
    """The coarse form of one channel.

    Attributes:
        learnt: arrays that `of` needs.
        together: rows of a block of codes.
        layers: of codes; all rows are scanned by the first, the best ones by all.
    """

    learnt: Learnt
    together: int
    layers: int

    def codes(self, stored: Tensor, layer: int = 0) -> Codes:
        """A layer of the coarse form of descriptors ``(N, *shape)``, for a file; the first axis is
        of rows or of blocks of rows."""

    def scan(
        self, queries: Sequence[Tensor], codes: Codes, rows: int, sweep: bool = True
    ) -> Tensor:
        """``(Q, rows)`` float32 coarse cosines of queries, each ``shape``, or ``(S, *shape)`` from
        all anchors, to the rows in ``codes``; of the best anchor or move, or without a sweep of the
        usual one."""


def learn(column: Column, sample: Tensor) -> Coarse:
    """The coarse form of a channel, learnt from descriptors ``(N, *shape)`` of a map."""
    return CoarseSigns(column) if column.dtype == "uint8" else CoarseVectors.learn(sample)


def of(column: Column, learnt: Learnt) -> Coarse:
    """The coarse form of a channel that was learnt before."""
    return CoarseSigns(column) if column.dtype == "uint8" else CoarseVectors(learnt)


class CoarseSigns:
    """`_BYTES` of each cell of signs ``(columns, rows, bytes)``; a query is moved by
    columns as in `channels.signs`."""

    together = 1

    def __init__(self, column: Column) -> None:
        self.learnt: Learnt = {}
        columns, rows, size = column.shape
        self._every = max(1, size // _BYTES)
        self.layers = 2 if size > self._every // 2 > 0 else 1
        self._columns, self._bits = columns, 8 * rows * len(range(0, size, self._every))
        self._more = 8 * rows * len(range(self._every // 2, size, self._every))
        self._reach = min(REACH, columns - 1)

    def codes(self, stored: Tensor, layer: int = 0) -> npt.NDArray[np.uint8]:
        """See `Coarse`: ``(N, columns, bytes)`` uint8, a column of whole words."""
        taken = stored[..., layer * self._every // 2 :: self._every].flatten(2)
        words: npt.NDArray[np.uint8] = F.pad(taken, (0, -taken.shape[2] % _WORD)).numpy()
        return words

    def scan(
        self, queries: Sequence[Tensor], codes: Codes, rows: int, sweep: bool = True
    ) -> Tensor:
        """See `Coarse`."""
        stacked = torch.stack([*queries])
        layers, bits = [self.codes(stacked)], self._bits
        if codes.shape[2] > layers[0].shape[2]:
            layers, bits = [*layers, self.codes(stacked, 1)], bits + self._more
        own = np.concatenate(layers, 2)
        reach = self._reach if sweep else 0
        scores, library = torch.empty(len(own), rows, dtype=torch.float32), core().library
        if library is None:
            for first in range(0, rows, _ROWS_AT_ONCE):
                part = torch.from_numpy(np.array(codes[first : first + _ROWS_AT_ONCE]))
                scores[:, first : first + len(part)] = self._plain(
                    torch.from_numpy(own), part, reach, bits
                )
            return scores
        size = self._columns, codes.shape[2]
        library.ssrvlad_scan_signs(
            address(own, (len(own), *size), "uint8"), len(own),
            address(codes, (rows, *size), "uint8"), rows, self._columns,
            codes.shape[2] // _WORD, bits, reach, torch.get_num_threads(),
            address(scores, (len(own), rows), "float32"),
        )  # fmt: skip
        return scores

    def _plain(self, queries: Tensor, rows: Tensor, reach: int, bits: int) -> Tensor:
        """The scores in torch: products of the numbers 1 and -1, without what fills the words."""
        signed, known = numbers(rows).flatten(1), numbers(queries)
        filling, best = 8 * math.prod(rows.shape[1:]) - self._columns * bits, []
        for step in range(-reach, reach + 1):
            kept = self._columns - abs(step)
            product = moved(known, step).flatten(1) @ signed.T
            best.append((product - filling * kept / self._columns) / (kept * bits))
        return torch.stack(best).amax(0)


class CoarseVectors:
    """`LENGTH` whole numbers from -127 to 127 of each vector, in blocks of `LANES` rows: ``(blocks,
    LENGTH, LANES)`` int8. A vector of length 1 is nearly ``mean + numbers @ basis``."""

    together, layers = LANES, 1

    def __init__(self, learnt: Learnt) -> None:
        self.learnt = learnt
        self._mean, self._basis = (torch.from_numpy(learnt[name]) for name in ("mean", "basis"))

    @classmethod
    def learn(cls, sample: Tensor) -> Self:
        """The form of vectors like those of a sample ``(N, D)``."""
        vectors = F.normalize(sample, dim=1).double()
        mean = vectors.mean(0)
        _, directions = torch.linalg.eigh((vectors - mean).T @ (vectors - mean))
        chosen = directions.flip(1)[:, :LENGTH]
        step = _DEVIATIONS * ((vectors - mean) @ chosen).square().mean(0).sqrt() / _MOST
        basis = torch.zeros(LENGTH, sample.shape[1], dtype=torch.float32)
        basis[: chosen.shape[1]] = (chosen * step.clamp(min=1e-9)).T.float()
        return cls({"mean": mean.float().numpy(), "basis": basis.numpy()})

    def codes(self, stored: Tensor, layer: int = 0) -> Codes:
        """See `Coarse`."""
        squares = self._basis.square().sum(1).clamp(min=1e-30)
        parts = [
            (F.normalize(part, dim=1) - self._mean) @ (self._basis / squares[:, None]).T
            for part in stored.split(_ROWS_AT_ONCE)
        ]
        whole = torch.cat(parts).round_().clamp_(-_MOST, _MOST)
        filled = F.pad(whole, (0, 0, 0, -len(whole) % LANES)).to(torch.int8)
        return filled.view(-1, LANES, LENGTH).transpose(1, 2).contiguous().numpy()

    def scan(
        self, queries: Sequence[Tensor], codes: Codes, rows: int, sweep: bool = True
    ) -> Tensor:
        """See `Coarse`."""
        swept = torch.stack([each if each.ndim == 2 else each[None] for each in queries])
        middle = swept.shape[1] // 2
        swept = swept if sweep else swept[:, middle : middle + 1]
        units = F.normalize(swept.float(), dim=2)
        weights, offsets = (units @ self._basis.T).contiguous(), (units @ self._mean).contiguous()
        shape, library = (len(swept), len(codes), LANES), core().library
        scores = torch.empty(shape, dtype=torch.float32)
        if library is None:
            for block, code in enumerate(codes):
                sums = weights @ torch.from_numpy(code.astype(np.float32)) + offsets[..., None]
                scores[:, block] = sums.amax(1)
        else:
            library.ssrvlad_scan_vectors(
                address(weights, (*swept.shape[:2], LENGTH), "float32"),
                address(offsets, swept.shape[:2], "float32"), len(swept), swept.shape[1],
                address(codes, (len(codes), LENGTH, LANES), "int8"), len(codes), LENGTH,
                torch.get_num_threads(), address(scores, shape, "float32"),
            )  # fmt: skip
        return scores.flatten(1)[:, :rows]
