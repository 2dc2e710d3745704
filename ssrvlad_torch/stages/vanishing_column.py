"""Vanishing column: the column towards which the street narrows, where the histograms stand.

A camera that is turned a little, or a car in another lane, shifts what it sees sideways. The
column in which ground, sidewalk and sky together are tallest moves with it. It stands for the
vanishing point, which a label map does not show. Not in the paper, which counts around the
centroid of each layer.
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
"""A column that is wholly open weighs ``ONE``, and openness weighs by its eighth power. The middle
of the image weighs as much as a twentieth of all columns, open: it decides where nothing is."""

SHIFT = (LEVELS.bit_length() - 1) * POWER - (ONE.bit_length() - 1)


def vanishing_columns(planes: Tensor) -> Tensor:
    """How many columns right of the middle the vanishing column is, in each image.

    Integers only: the open pixels of a column in 64ths of its height, to the eighth power, are
    its weight, and the weighted mean of the columns is rounded to the nearest, halves up.

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
