"""Grid pooling: the fraction of each of 24 x 32 cells that a mask covers. Not in the paper."""

import torch
from torch import Tensor

from .tracing import real

CELLS = ROWS, COLUMNS = 24, 32
"""Rows and columns of cells. The method treats them as square, so every image as one of 4:3."""


def pool(masks: Tensor, shift: Tensor) -> Tensor:
    """The fraction ``(B, K, ROWS, COLUMNS)`` of every cell that each of masks ``(B, K, H, W)``, 1
    or 0, covers, the image moved ``shift`` ``(B,)`` int64 columns left.

    A pixel counts in every cell that it overlaps, by the overlap. Overlaps are whole numbers in
    units of ``1 / (H * ROWS)`` and ``1 / (W * COLUMNS)``, so the sums are whole numbers too, exact
    in any order: in float32 up to ``H * W = 2 ** 24``. Columns that come in from outside the image
    are empty."""
    height, width = masks.shape[2:]
    columns = overlaps(width, COLUMNS, shift)
    rows = overlaps(height, ROWS, torch.zeros_like(shift)).to(real())
    in_columns = torch.bmm(masks.flatten(1, 2).float(), columns).unflatten(1, masks.shape[1:3])
    summed = torch.bmm(in_columns.transpose(2, 3).flatten(1, 2).to(real()), rows)
    shares: Tensor = summed.unflatten(1, (-1, COLUMNS)).transpose(2, 3)
    return shares / (height * width)


def overlaps(pixels: int, cells: int, shift: Tensor) -> Tensor:
    """``(B, pixels, cells)`` float32 whole numbers: how much of each pixel lies in each cell, in
    units of ``1 / (pixels * cells)`` of a line of ``pixels`` pixels."""
    pixel = (torch.arange(pixels, device=shift.device) - shift[:, None])[..., None] * cells
    cell = torch.arange(cells, device=shift.device) * pixels
    within = torch.minimum(pixel + cells, cell + pixels) - torch.maximum(pixel, cell)
    return within.float().relu()
