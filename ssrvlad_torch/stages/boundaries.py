"""Boundaries: where the layers meet, by direction. Not in the paper.

A boundary is located more sharply than an area, and it stays where it is when a network confuses
two classes. The four diagonal neighbours of a pixel, two rows and two columns apart, give its
direction: two adjacent ones in the layer make a straight boundary, one or three a slanting one.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..bitplanes import Bits

DIRECTIONS = ("upright", "level", "rising", "falling")
"""Bits 0 to 3. A rising boundary goes up to the right."""

WIDTH = 2
"""Width of a straight boundary, in pixels."""


def boundaries(planes: Tensor) -> Tensor:
    """The directions of the boundaries of all layers at each pixel.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        ``(B, H, W)`` uint8, bit ``d`` for direction ``d``. Pixels at the image's edge have none.
    """
    if min(planes.shape[1:]) < 3:
        return torch.zeros_like(planes)
    above, below = planes[:, :-2], planes[:, 2:]
    corners = (row[..., part] for row in (above, below) for part in (slice(-2), slice(2, None)))
    inner = torch.zeros_like(planes[:, 1:-1, 1:-1])
    for bit, layers in enumerate(directions(*corners)):
        inner |= (layers != 0).to(torch.uint8) << bit
    return F.pad(inner, (1, 1, 1, 1))


def directions(nw: Bits, ne: Bits, sw: Bits, se: Bits) -> tuple[Bits, ...]:
    """Bit-planes of the layers with a boundary in each direction, from the diagonal neighbours."""
    north, south, west, east = nw ^ ne, sw ^ se, nw ^ sw, ne ^ se
    return (
        north & south & ~(west | east),
        west & east & ~(north | south),
        (north & west & ~(south | east)) | (south & east & ~(north | west)),
        (north & east & ~(south | west)) | (south & west & ~(north | east)),
    )
