"""Histograms of oriented gradients (Dalal & Triggs, CVPR 2005) on a coarse grid of an image."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .channel import View
from .gray import grays, resize
from .vectors import VectorChannel

CELL = 16
"""Side of a cell in pixels, after the picture has become ``CELL`` times the grid."""

ORIENTATIONS = 8


class HOG(VectorChannel):
    """One histogram of gradient directions for each cell of a grid.

    The gray picture is resized to 16 pixels a cell; histograms are those of ``skimage.feature.hog``
    with one cell a block and ``block_norm="L2"``. The whole descriptor has length 1.
    """

    name = "hog"
    trust = 2.0

    def __init__(self, rows: int = 6, columns: int = 10) -> None:
        if rows < 1 or columns < 1:
            raise ValueError(f"hog: the grid must be 1 x 1 or more, got {rows} x {columns}")
        self.rows, self.columns, self.length = rows, columns, ORIENTATIONS * rows * columns
        self.fingerprint = f"{rows} x {columns} cells, {ORIENTATIONS} directions"

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        pictures = grays(views, self.name)
        small = resize(pictures, CELL * self.rows, CELL * self.columns).float()
        along_x = F.pad(small[:, :, 2:] - small[:, :, :-2], (1, 1))
        along_y = F.pad(small[:, 2:] - small[:, :-2], (0, 0, 1, 1))
        turn = torch.atan2(along_y.double(), along_x.double()) / torch.pi % 1
        bins = (turn * ORIENTATIONS).long()
        cells = cell_histograms(bins, torch.hypot(along_x, along_y), ORIENTATIONS)
        return F.normalize(F.normalize(cells, dim=-1).flatten(1), dim=1)


def cell_histograms(bins: Tensor, votes: Tensor, count: int) -> Tensor:
    """Sums of votes ``(B, H, W)`` float of each bin over square cells of ``CELL`` pixels, ``(B, H /
    CELL, W / CELL, count)``; ``bins`` ``(B, H, W)`` int64 are 0 to ``count - 1``."""
    images, height, width = bins.shape
    row, column = (torch.arange(side, device=bins.device) // CELL for side in (height, width))
    entry = (row[:, None] * (width // CELL) + column) * count + bins
    sums = votes.new_zeros(images, height // CELL * (width // CELL) * count)
    sums.scatter_add_(1, entry.flatten(1), votes.flatten(1))
    return sums.view(images, height // CELL, width // CELL, count)
