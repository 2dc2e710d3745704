"""Vanishing column: the column towards which the street narrows, the anchor of the histograms.

When the camera turns a little or the car drives in another lane, the image shifts sideways. The
column in which ground, sidewalk and sky together are tallest shifts with it. It replaces the
vanishing point, which a label map does not show. Not in the paper.
"""

from functools import reduce
from operator import or_

import torch
import torch.nn.functional as F
from torch import Tensor

from .tracing import real

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
"""Columns of the widest grid whose sums are exact in float32: a digit of them is below
``14 * MAX_WIDTH ** 2``, of all weights and of the middle, times twice the distance of two
columns."""

_RADIX, _DIGITS = 8, 7
"""Digits of a weight, which is at most ``ONE``: sums of weights have up to forty bits, too many for
float32."""


def vanishing_columns(numbers: Tensor) -> Tensor:
    """``(B,)`` int64, how many columns right of the middle, negative to the left, the vanishing
    column is in numbers ``(B, H, W)`` from `merge`; under export at most `MAX_WIDTH` columns.

    It is the weighted mean of the columns in whole numbers, rounded to the nearest, halves up.
    """
    height, width = numbers.shape[1:]
    is_open = reduce(or_, [numbers == layer for layer in OPEN_LAYERS])
    open_pixels = is_open.to(real(height)).sum(1)
    level = torch.floor((open_pixels * LEVELS + 0.5) / height).to(torch.int64)
    table = _digits([level**POWER >> SHIFT for level in range(LEVELS + 1)], numbers.device)
    weight = F.embedding(level, table)  # (B, W, digits)
    twice_from_middle = (2 * torch.arange(width, device=numbers.device) - (width - 1)).to(real())
    moment = (weight * twice_from_middle[:, None]).sum(1)
    whole, rest = divmod(ONE, PULL)
    pull = _digits([whole, 1], numbers.device)
    total = weight.sum(1) + pull[0] * width + pull[1] * (width * rest // PULL)

    powers = _RADIX ** torch.arange(_DIGITS, device=numbers.device).to(real())
    sums, totals = moment @ powers, total @ powers
    estimate = torch.floor((sums + totals) / (totals * 2))  # it may be off by one
    column = estimate[:, None] + torch.arange(-1, 2, device=numbers.device)
    left = (moment + total)[:, None] - column[..., None] * (total * 2)[:, None]
    carried, *higher = left.unbind(2)
    for digit in higher:
        carried = digit + torch.floor(carried * (1 / _RADIX))
    result: Tensor = estimate - 2 + (carried >= 0).to(real()).sum(1)
    return result.to(torch.int64)


def _digits(numbers: list[int], device: torch.device) -> Tensor:
    """``(n, digits)``, lowest first."""
    rows = [[number // _RADIX**place % _RADIX for place in range(_DIGITS)] for number in numbers]
    return torch.tensor(rows, dtype=real(), device=device)
