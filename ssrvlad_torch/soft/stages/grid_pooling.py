"""Soft grid pooling: what fraction of each cell a layer covers, moved by any number of columns."""

from __future__ import annotations

import torch
from torch import Tensor


def soft_pool(layers: Tensor, shift: Tensor, cells: tuple[int, int]) -> Tensor:
    """The fraction of every cell that each layer covers, the image moved ``shift`` columns left.

    Args:
        layers: ``(B, 8, h, w)``, 0 to 1.
        shift: ``(B,)`` columns, not whole ones only, negative to move right.
        cells: rows and columns of the grid of cells.

    Returns:
        ``(B, 8, rows, columns)``, 0 to 1. It is what `pool` gives for whole layers and shifts.
    """
    upright = soft_overlaps(layers.shape[2], cells[0], shift.new_zeros(1))
    across = soft_overlaps(layers.shape[3], cells[1], shift)
    return upright.mT[:, None] @ layers @ across[:, None]


def soft_overlaps(pixels: int, cells: int, shift: Tensor) -> Tensor:
    """``(B, pixels, cells)``, how much of each cell of a line each pixel covers."""
    pixel = ((torch.arange(pixels).to(shift) - shift[:, None]) * (cells / pixels))[..., None]
    cell = torch.arange(cells).to(shift)
    within = torch.minimum(pixel + cells / pixels, cell + 1) - torch.maximum(pixel, cell)
    return within.clamp(min=0)
