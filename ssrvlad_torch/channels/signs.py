"""Signs: descriptors of bits on a grid of cells, compared by how many agree.

A descriptor is ``(columns, rows, bytes)`` uint8; a bit is 1 for plus and 0 for minus. The score is
the cosine of the numbers 1 and -1, or of these without the mean of each traverse. A query is also
moved by columns to each side; the columns that overlap count, and the best move. Not in the paper.
"""

import numpy as np
import torch
from torch import Tensor

from ..native import core

REACH = 2
"""Columns by which a query is moved to each side."""

_ROWS_AT_ONCE = 256


def moved(grids: Tensor, columns: int) -> Tensor:
    """``(N, columns, ...)`` moved to the right by some columns; zero comes in from outside."""
    after, kept = torch.zeros_like(grids), max(0, grids.shape[1] - abs(columns))
    to, source = max(0, columns), max(0, -columns)
    after[:, to : to + kept] = grids[:, source : source + kept]
    return after


def numbers(signs: Tensor) -> Tensor:
    """Signs ``(..., bytes)`` as 1 and -1, ``(..., 8 * bytes)`` float32."""
    bits = np.unpackbits(signs.numpy(force=True), axis=-1, bitorder="little")
    return torch.from_numpy(bits).float().mul_(2).sub_(1)


def products(queries: Tensor, masks: Tensor, references: Tensor) -> Tensor:
    """``(Q, R)`` int32 products of the numbers 1 and -1 of queries ``(Q, B)`` and references
    ``(R, B)`` uint8, over the bits that are set in the masks; B is a multiple of 8 for the
    native core."""
    counted = numbers(masks).add_(1).div_(2)
    library = core().library
    if library is None or queries.shape[1] % 8:
        signed = numbers(queries) * counted
        parts = [signed @ numbers(part).T for part in references.split(_ROWS_AT_ONCE)]
        return torch.cat([signed[:, :0], *parts], 1).int()
    queries, masks, references = (each.contiguous() for each in (queries, masks, references))
    different = torch.empty((len(queries), len(references)), dtype=torch.int32)
    library.ssrvlad_differing(
        queries.data_ptr(), masks.data_ptr(), len(queries), references.data_ptr(), len(references),
        queries.shape[1] // 8, torch.get_num_threads(), different.data_ptr(),
    )  # fmt: skip
    return counted.sum(1, dtype=torch.int32)[:, None] - 2 * different
