"""Vanishing column: the column towards which the street narrows, the anchor of the histograms.

When the camera turns a little or the car drives in another lane, the image shifts sideways. The
column in which ground, sidewalk and sky together are tallest shifts with it. It replaces the
vanishing point, which a label map does not show. Not in the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor

OPEN_LAYERS = 1 << 0 | 1 << 1 | 1 << 5
"""Ground, sidewalk and sky: where one can drive, walk, or see far."""

LEVELS = 64
POWER = 8
ONE = 1 << 20
PULL = 20
"""The weight of a column is the eighth power of its open pixels in 64ths of its height, scaled to
``ONE`` for a fully open column. The middle of the image has the weight of a twentieth of all
columns, fully open: without open pixels it is the vanishing column."""

SHIFT = (LEVELS.bit_length() - 1) * POWER - (ONE.bit_length() - 1)


def vanishing_columns(planes: Tensor) -> Tensor:
    """How many columns right of the middle the vanishing column is, in each image.

    It is the weighted mean of the columns in integers, rounded to the nearest, halves up.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        ``(B,)`` int64, negative to the left.
    """
    height, width = planes.shape[1:]
    open_pixels = (planes & OPEN_LAYERS != 0).sum(1)
    weight = (open_pixels * LEVELS // height) ** POWER >> SHIFT
    twice_from_middle = 2 * torch.arange(width, device=planes.device) - (width - 1)
    total = weight.sum(1) + width * ONE // PULL
    return ((weight * twice_from_middle).sum(1) + total) // (2 * total)
