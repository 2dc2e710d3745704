"""Vanishing column: the column towards which the street narrows, the anchor of the histograms.

When the camera turns a little or the car drives in another lane, the image shifts sideways. The
column in which ground, sidewalk and sky together are tallest shifts with it. It replaces the
vanishing point, which a label map does not show. Not in the paper."""

from functools import reduce
from operator import or_

import torch
from torch import Tensor

from .tracing import divided, looked_up, real, sum_of_integers

OPEN_LAYERS = (0, 1, 5)
"""Ground, sidewalk and sky: where one can drive, walk, or see far."""

LEVELS = 64
POWER = 8
ONE = 1 << 20
PULL = 20
"""The weight of a column is the eighth power of its open pixels in 64ths of its height, scaled to
``ONE`` for a fully open column. The middle of the image has the weight of a twentieth of all
columns, fully open: without open pixels it is the vanishing column."""

SHIFT = (LEVELS.bit_length() - 1) * POWER - (ONE.bit_length() - 1)

MAX_WIDTH = 960
"""Columns of the widest grid in an exported file: a weight times twice its distance from the middle
stays below ``2 ** 31``, and so does twice the sum of all weights."""


def vanishing_columns(numbers: Tensor) -> Tensor:
    """``(B,)`` int64, how many columns right of the middle, negative to the left, the vanishing
    column is in numbers ``(B, H, W)`` from `merge`; under export at most `MAX_WIDTH` columns.

    It is the weighted mean of the columns in whole numbers, rounded to the nearest, halves up."""
    height, width = numbers.shape[1:]
    is_open = reduce(or_, [numbers == layer for layer in OPEN_LAYERS])
    level = torch.floor((is_open.sum(1).float() * LEVELS + 0.5) / height).to(torch.int64)
    table = torch.tensor([level**POWER >> SHIFT for level in range(LEVELS + 1)])
    weight = looked_up(table.to(level.device), level.flatten()).view(level.shape)
    moments = weight * (2 * torch.arange(width, device=level.device) - (width - 1))
    pull = ONE // PULL * width + ONE % PULL * width // PULL
    total = sum_of_integers(weight) + pull
    mean = moments.to(real()).sum(1) / total  # from the middle, in halves of a column
    return divided(sum_of_integers(moments) + total, 2 * total, (mean + 1) / 2)[0]
