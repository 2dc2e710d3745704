"""Boundaries: where the layers meet, by direction. Not in the paper.

A boundary is located more sharply than an area, and it stays where it is when a network confuses
two classes. The four diagonal neighbours of a pixel, two rows and two columns apart, give its
direction: two adjacent ones in the layer make a straight boundary, one or three a slanting one.
"""

from functools import cache

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import AREA_LAYERS

PATTERNS = {
    "upright": ("1010", "0101"),
    "level": ("1100", "0011"),
    "rising": ("1000", "0001", "0111", "1110"),
    "falling": ("0100", "0010", "1011", "1101"),
}
"""Of each direction of a boundary: which of the corners NW, NE, SW, SE lie in the layer. A rising
boundary goes up to the right."""

DIRECTIONS = tuple(PATTERNS)

WIDTH = 2
"""Width of a straight boundary, in pixels."""

_OUTSIDE = AREA_LAYERS + 1
"""What a corner outside the image holds, after the layers and none."""

_NUMBERS = _OUTSIDE + 1


def boundaries(numbers: Tensor) -> Tensor:
    """The directions ``(B, 4, H, W)``, 1 or 0 each, of the boundaries of all layers at each pixel,
    looked up by the numbers ``(B, H, W)`` from `merge` of its diagonal neighbours. Pixels at the
    image's edge have none."""
    padded = F.pad(numbers.float(), (1, 1, 1, 1), value=_OUTSIDE)
    above_below = padded[:, :-2] + padded[:, 2:] * _NUMBERS**2
    code = above_below[..., :-2] + above_below[..., 2:] * _NUMBERS
    table = torch.tensor(_table(), dtype=torch.float32, device=numbers.device)
    return F.embedding(code.to(torch.int64), table).permute(0, 3, 1, 2)


@cache
def _table() -> npt.NDArray[np.bool_]:
    """``(8 ** 4, 4)``, whether the boundary of any layer has the direction, for the layers NW, NE,
    SW and SE, of which NW changes fastest."""
    code = np.arange(_NUMBERS**4)[:, None, None]
    corners = code // _NUMBERS ** np.arange(4) % _NUMBERS
    inside = (corners != _OUTSIDE).all((1, 2))
    in_layer = corners == np.arange(AREA_LAYERS)[:, None]
    directions = []
    for patterns in PATTERNS.values():
        expected = np.array([[corner == "1" for corner in pattern] for pattern in patterns])
        directions.append(inside & (in_layer[:, :, None] == expected).all(3).any((1, 2)))
    return np.stack(directions, 1)
