"""Grid pooling: the fraction of each of 24 x 32 cells that a layer covers. Not in the paper."""

from __future__ import annotations

import torch
from torch import Tensor

from ..bitplanes import unpack

CELLS = ROWS, COLUMNS = 24, 32
"""Rows and columns of cells. The method treats them as square, so every image as one of 4:3."""

_PIXELS_AT_ONCE = 1 << 20


def pool(planes: Tensor, shift: Tensor) -> Tensor:
    """The fraction of every cell that each layer covers, the image moved ``shift`` columns left.

    A pixel counts in every cell that it overlaps, by the overlap. Overlaps are integers in units
    of ``1 / (H * ROWS)`` and ``1 / (W * COLUMNS)``, so the sums are integers too, exact in any
    order. Columns that come in from outside the image are empty.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        shift: ``(B,)`` int64 columns, negative to move right.

    Returns:
        ``(B, 8, ROWS, COLUMNS)`` float64, 0 to 1.
    """
    height, width = planes.shape[1:]
    images_at_once = max(1, _PIXELS_AT_ONCE // (height * width))
    columns = overlaps(width, COLUMNS, shift)
    rows = overlaps(height, ROWS, shift.new_zeros(1)).double().transpose(1, 2)
    sums = [
        rows @ (unpack(part).float() @ part_columns[:, None]).double()
        for part, part_columns in zip(
            planes.split(images_at_once), columns.split(images_at_once), strict=True
        )
    ]
    return torch.cat(sums) / (height * width)


def overlaps(pixels: int, cells: int, shift: Tensor) -> Tensor:
    """``(B, pixels, cells)`` float32 integers: how much of each pixel lies in each cell.

    The unit is ``1 / (pixels * cells)`` of a line of ``pixels`` pixels.
    """
    pixel = (torch.arange(pixels, device=shift.device) - shift[:, None])[..., None] * cells
    cell = torch.arange(cells, device=shift.device) * pixels
    within = torch.minimum(pixel + cells, cell + pixels) - torch.maximum(pixel, cell)
    return within.clamp(min=0).float()
