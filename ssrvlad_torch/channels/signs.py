"""Signs: descriptors of bits on a grid of cells, compared by how many agree.

A descriptor is ``(columns, rows, bytes)`` uint8; a bit is 1 for plus and 0 for minus. The score is
the cosine of the numbers 1 and -1, or of these without the mean of each sequence. A query is also
moved by up to three columns to each side and two rows up and down; the cells that overlap count,
and the best move. Not in the paper."""

import numpy as np
import torch
from torch import Tensor

ACROSS, DOWN = 3, 2
"""Cells by which a query is moved to each side, and up and down."""


def numbers(signs: Tensor) -> Tensor:
    """Signs ``(..., bytes)`` as 1 and -1, ``(..., 8 * bytes)`` float32."""
    bits = np.unpackbits(signs.numpy(force=True), axis=-1, bitorder="little")
    return torch.from_numpy(bits).float().mul_(2).sub_(1)
