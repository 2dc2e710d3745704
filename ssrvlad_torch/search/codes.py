"""Codes: descriptors as few whole numbers, to compare a query with all rows of a large map.

A code holds numbers from -127 to 127 along the directions in which the rows of a map differ most
(principal components): a descriptor is nearly ``mean + code @ basis``. Of signs, some bytes of each
cell count. Not in the paper."""

from __future__ import annotations

import itertools
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.signs import ACROSS, DOWN, numbers

VECTOR_LENGTH, SIGNS_LENGTH = 64, 256
"""Numbers of a code."""

_BYTES = 4
"""Of a cell of signs."""
_MOST, _DEVIATIONS = 127, 4.0
_CODED, _COMPARED = 1 << 12, 1 << 10
"""Rows at once; so few are compared because they stay in the cache of a processor."""


class Coder(NamedTuple):
    """Makes and compares codes of a channel by a mean ``(D,)`` and a basis ``(length, D)``."""

    mean: Tensor
    basis: Tensor

    @classmethod
    def learn(cls, sample: Tensor) -> Self:
        """The codes of descriptors like those of a sample ``(N, *shape)``."""
        features = _numbers(sample)
        length = VECTOR_LENGTH if sample.dtype != torch.uint8 else SIGNS_LENGTH
        mean = features.mean(0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            centred = features - mean
            _, _, directions = torch.pca_lowrank(centred, min(length, *features.shape), False)
        deviations = (centred @ directions).square().mean(0).sqrt()
        steps = (_DEVIATIONS * deviations / _MOST).clamp(min=1e-9)
        return cls(mean, (directions * steps).T.contiguous())

    def codes(self, descriptors: Tensor) -> npt.NDArray[np.int8]:
        """``(N, length)`` of descriptors ``(N, *shape)``."""
        weights = self.basis.T / self.basis.square().sum(1).clamp(min=1e-30)
        offsets = self.mean @ weights
        parts = [_numbers(block) @ weights - offsets for block in descriptors.split(_CODED)]
        whole: npt.NDArray[np.int8] = (
            torch.cat(parts).round_().clamp_(-_MOST, _MOST).to(torch.int8).numpy()
        )
        return whole

    def scores(self, queries: Tensor, codes: npt.NDArray[np.int8], sweep: bool) -> Tensor:
        """``(Q, R)`` float32, the scores of queries ``(Q, *shape)``, of vectors also from all
        anchors, ``(Q, S, D)``, to the rows of codes; of the best anchor or move, or without a
        ``sweep`` of the usual one."""
        probes = _probes(queries, sweep)
        weights, offsets = probes @ self.basis.T, probes @ self.mean
        scores = torch.empty(len(probes), len(codes))
        for first in range(0, len(codes), _COMPARED):
            block = torch.from_numpy(codes[first : first + _COMPARED]).float()
            products = (weights.flatten(0, 1) @ block.T).view(*offsets.shape, len(block))
            scores[:, first : first + len(block)] = products.add_(offsets[..., None]).amax(1)
        return scores


def _numbers(descriptors: Tensor) -> Tensor:
    """``(N, D)`` float32: vectors at length 1, of signs 1 and -1."""
    if descriptors.dtype != torch.uint8:
        return F.normalize(descriptors.float(), dim=1)
    return _grids(descriptors).flatten(1)


def _grids(signs: Tensor) -> Tensor:
    """``(N, columns, rows, bits)`` of the bytes that count, as 1 and -1."""
    return numbers(signs[..., :: max(1, signs.shape[-1] // _BYTES)])


def _probes(queries: Tensor, sweep: bool) -> Tensor:
    """``(Q, P, D)``, what each query is compared as: from its anchors, or of signs moved, with
    zeros for what comes in, and divided by the number of signs that overlap."""
    if queries.dtype != torch.uint8:
        swept = queries if queries.ndim == 3 else queries[:, None]
        middle = swept.shape[1] // 2
        return F.normalize((swept if sweep else swept[:, middle : middle + 1]).float(), dim=2)
    grids = _grids(queries)
    columns, rows, bits = grids.shape[1:]
    across, down = (min(ACROSS, columns - 1), min(DOWN, rows - 1)) if sweep else (0, 0)
    moves = itertools.product(range(-across, across + 1), range(-down, down + 1))
    return torch.stack(
        [
            F.pad(grids, (0, 0, row, -row, column, -column)).flatten(1)
            / (bits * (columns - abs(column)) * (rows - abs(row)))
            for column, row in moves
        ],
        1,
    )
