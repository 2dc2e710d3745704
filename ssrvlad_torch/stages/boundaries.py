"""Boundaries: where the layers meet, by direction. Not in the paper.

A boundary is located more sharply than an area, and it stays where it is when a network confuses
two classes. The four diagonal neighbours of a pixel, two rows and two columns apart, give its
direction: two adjacent ones in the layer make a straight boundary, one or three a slanting one."""

from functools import cache

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import AREA_LAYERS

DIRECTIONS = ("upright", "level", "rising", "falling")
"""A rising boundary goes up to the right."""

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
    code = np.arange(_NUMBERS**4)[:, None]
    corners = [code // _NUMBERS**place % _NUMBERS for place in range(4)]
    inside = np.all([corner != _OUTSIDE for corner in corners], 0)
    nw, ne, sw, se = (inside & (corner == np.arange(AREA_LAYERS)) for corner in corners)
    north, south, west, east = nw ^ ne, sw ^ se, nw ^ sw, ne ^ se
    directions = (
        north & south & ~(west | east),
        west & east & ~(north | south),
        (north & west & ~(south | east)) | (south & east & ~(north | west)),
        (north & east & ~(south | west)) | (south & west & ~(north | east)),
    )
    return np.stack([layers.any(1) for layers in directions], 1)
