"""Boundaries: where the layers meet, by direction. Not in the paper.

What the area of a layer says coarsely, its outline says sharply, and it says it whichever layer
the network took the pixels for. The direction of a boundary is seen at a pixel's four diagonal
neighbours, two rows and two columns apart: two beside each other in the layer make a straight
boundary, one or three a slanting one.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..bitplanes import Bits

DIRECTIONS = ("upright", "level", "rising", "falling")
"""Bits 0 to 3. What rises goes up to the right."""

WIDTH = 2
"""Pixels across a straight boundary, each of which sees it."""


def boundaries(planes: Tensor) -> Tensor:
    """The directions in which a boundary of any layer runs past each pixel.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        ``(B, H, W)`` uint8, bit ``d`` for direction ``d``. Pixels at the image's edge have none.
    """
    if min(planes.shape[1:]) < 3:
        return torch.zeros_like(planes)
    above, below = planes[:, :-2], planes[:, 2:]
    corners = (row[..., part] for row in (above, below) for part in (slice(-2), slice(2, None)))
    found = torch.zeros_like(planes[:, 1:-1, 1:-1])
    for bit, layers in enumerate(directions(*corners)):
        found |= (layers != 0).to(torch.uint8) << bit
    return F.pad(found, (1, 1, 1, 1))


def directions(nw: Bits, ne: Bits, sw: Bits, se: Bits) -> tuple[Bits, ...]:
    """Bit-planes of the layers with a boundary in each direction, from the diagonal neighbours."""
    north, south, west, east = nw ^ ne, sw ^ se, nw ^ sw, ne ^ se
    return (
        north & south & ~(west | east),
        west & east & ~(north | south),
        (north & west & ~(south | east)) | (south & east & ~(north | west)),
        (north & east & ~(south | west)) | (south & west & ~(north | east)),
    )
