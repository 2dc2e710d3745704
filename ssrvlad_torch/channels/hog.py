"""Histograms of oriented gradients (Dalal & Triggs, CVPR 2005) on a grid of a gray picture, in
integers of at most 24 bits up to the histograms, the same on every runtime."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .channel import Channel, View, picture_of

_LUMA = (19595, 38470, 7471)
"""Weights of red, green and blue, parts of 65536."""
_PARTS = 2048


def grays(views: Sequence[View], channel: str) -> Tensor:
    """``(B, H, W)`` uint8, the luma of views of one size, see `luma`; errors of `picture_of`."""
    return luma(torch.from_numpy(np.stack([picture_of(view, channel) for view in views])))


def luma(pictures: Tensor) -> Tensor:
    """``(B, H, W)`` uint8, the luma (ITU-R BT.601) of pictures ``(B, H, W, 3)`` uint8 in RGB, as
    Pillow rounds it."""
    red, green, blue = pictures.int().unbind(3)
    sums = red * _LUMA[0] + green * _LUMA[1] + blue * _LUMA[2]
    return ((sums + 32768) // 65536).to(torch.uint8)


def resize(pictures: Tensor, height: int, width: int) -> Tensor:
    """``(B, H, W)`` uint8 pictures at another size, as OpenCV's ``INTER_LINEAR`` for 8 bits:
    bilinear between pixel centres, in integers, whose low bits are dropped."""
    device = pictures.device
    (up, up_weight), (down, down_weight) = _taps(pictures.shape[1], height, device)
    (left, left_weight), (right, right_weight) = _taps(pictures.shape[2], width, device)
    wide = pictures.int()
    rows = (wide[:, :, left] * left_weight + wide[:, :, right] * right_weight) // 16
    upper = _weighed(rows[:, up], up_weight[:, None])
    lower = _weighed(rows[:, down], down_weight[:, None])
    return ((upper + lower + 2) // 4).to(torch.uint8)


def _weighed(rows: Tensor, weight: Tensor) -> Tensor:
    """``rows * weight // 65536`` for rows below 2 ** 15, without a number of more than 24 bits."""
    high, low = rows // 128, rows % 128
    return (high * weight + low * weight // 128) // 512


def _taps(before: int, after: int, device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """The two source positions of each position after resizing, each with its weight. Positions are
    rounded to float32."""
    halves = 2 * torch.arange(after, dtype=torch.int32, device=device) + 1
    position = (halves * before - after).float() / (2 * after)
    first = position.floor()
    return [
        ((first.long() + step).clamp(0, before - 1), (weight * _PARTS).round().int())
        for step, weight in enumerate((1 - (position - first), position - first))
    ]


CELL = 16
"""Side of a cell in pixels, after the picture has become ``CELL`` times the grid."""

ROWS, COLUMNS, ORIENTATIONS = 6, 10, 8
"""Of the grid of cells, and directions of a histogram."""


class HOG(Channel):
    """One histogram of gradient directions for each of 6 x 10 cells.

    The gray picture is resized to 16 pixels a cell; histograms are those of ``skimage.feature.hog``
    with one cell a block and ``block_norm="L2"``. The whole descriptor has length 1."""

    name, shape = "hog", (ORIENTATIONS * ROWS * COLUMNS,)
    fingerprint = f"{ROWS} x {COLUMNS} cells, {ORIENTATIONS} directions"
    trust = 2.0

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        return self.histograms(grays(views, self.name))

    def histograms(self, pictures: Tensor) -> Tensor:
        """``(B, *shape)`` float32 of gray pictures ``(B, H, W)`` uint8."""
        small = resize(pictures, CELL * ROWS, CELL * COLUMNS).float()
        along_x = F.pad(small[:, :, 2:] - small[:, :, :-2], (1, 1))
        along_y = F.pad(small[:, 2:] - small[:, :-2], (0, 0, 1, 1))
        votes = (along_x.square() + along_y.square()).sqrt()
        cells = cell_histograms(directions(along_x, along_y), votes, ORIENTATIONS)
        return F.normalize(F.normalize(cells, dim=-1).flatten(1), dim=1)


def directions(along_x: Tensor, along_y: Tensor) -> Tensor:
    """The eighth of a half turn, int64 0 to 7, in which the direction of each gradient lies, up to
    its sign. Gradients are whole numbers. Limits are 22.5 degrees apart, and each belongs to the
    eighth above it. No angle is computed, so every runtime gives the same."""
    below = (along_y < 0) | ((along_y == 0) & (along_x < 0))
    x, y = (torch.where(below, -along, along) for along in (along_x, along_y))
    passed = [y >= _SLOPE * x, y >= x, _SLOPE * y >= x, x <= 0]
    passed += [-x >= _SLOPE * y, -x >= y, -_SLOPE * x >= y]
    return torch.stack(passed).sum(0)


_SLOPE = 2**0.5 - 1
"""Of 22.5 degrees. Whole numbers of at most 255 miss it by more than float32 rounds."""


def cell_histograms(bins: Tensor, votes: Tensor, count: int) -> Tensor:
    """Sums of votes ``(B, H, W)`` float of each bin over square cells of ``CELL`` pixels, ``(B, H /
    CELL, W / CELL, count)``; ``bins`` ``(B, H, W)`` int64 are 0 to ``count - 1``."""
    images, height, width = bins.shape
    row, column = (torch.arange(side, device=bins.device) // CELL for side in (height, width))
    entry = (row[:, None] * (width // CELL) + column) * count + bins
    sums = votes.new_zeros(images, height // CELL * (width // CELL) * count)
    sums.scatter_add_(1, entry.flatten(1), votes.flatten(1))
    return sums.view(images, height // CELL, width // CELL, count)
