"""Soft grid pooling: the fraction of each cell that a layer covers, for any real shift."""

import torch
from torch import Tensor


def soft_pool(layers: Tensor, shift: Tensor, cells: tuple[int, int]) -> Tensor:
    """``(B, 8, rows, columns)``, 0 to 1, the fraction of every cell that each of layers ``(B, 8, h,
    w)`` covers, the image moved ``shift`` ``(B,)`` columns, any real number, to the left; equal to
    `pool` for layers of 0 and 1 and whole shifts."""
    rows = soft_overlaps(layers.shape[2], cells[0], shift.new_zeros(1))
    columns = soft_overlaps(layers.shape[3], cells[1], shift)
    return rows.mT[:, None] @ layers @ columns[:, None]


def soft_overlaps(pixels: int, cells: int, shift: Tensor) -> Tensor:
    """``(B, pixels, cells)``, how much of each cell of a line each pixel covers."""
    pixel = ((torch.arange(pixels).to(shift) - shift[:, None]) * (cells / pixels))[..., None]
    cell = torch.arange(cells).to(shift)
    within = torch.minimum(pixel + cells / pixels, cell + 1) - torch.maximum(pixel, cell)
    return within.clamp(min=0)
