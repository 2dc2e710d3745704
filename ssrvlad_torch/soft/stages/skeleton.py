"""Soft skeleton: a mixture of the thinned skeleton and of iterated soft erosion and opening.

The skeleton of Shit et al., clDice, CVPR 2021, has a gradient at every pixel, but on street layers
it falls into pieces, so its end points are not those of the method. The other part is the layer at
the pixels that the hard thinning keeps; its gradient is that of the layer.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

COARSE = 48
"""Largest shorter side of the grid for erosion; a larger image is averaged in squares first."""


def soft_skeleton(layers: Tensor, thinned: Tensor, softness: float) -> Tensor:
    """The weight of every pixel in the skeleton of its layer.

    Args:
        layers: ``(B, 8, h, w)`` clean layers, 0 to 1.
        thinned: ``(B, 8, h, w)`` bool, the skeleton of the hard layers.
        softness: fraction of the eroded skeleton in the mixture, 0 to 1. At 0 the result is the
            hard skeleton if the layers are 0 and 1.

    Returns:
        ``(B, 8, h, w)``, 0 to 1.
    """
    hard = layers * thinned
    if not softness:
        return hard
    eroded: Tensor = checkpoint(eroded_skeleton, layers, use_reentrant=False)
    return hard + softness * (eroded - hard)


def eroded_skeleton(layers: Tensor) -> Tensor:
    """The soft skeleton of Shit et al.: what an opening removes from the layers, at every erosion.

    It is computed on a grid of at most `COARSE` rows or columns and spread over the pixels of each
    cell so that lengths stay the same. The number of erosions is half the grid's longer side:
    after that, nothing inside the image is left.

    Args:
        layers: ``(B, K, h, w)``, 0 to 1.

    Returns:
        ``(B, K, h, w)``, 0 to 1.
    """
    height, width = layers.shape[2:]
    side = -(-min(height, width) // COARSE)
    cells = F.avg_pool2d(layers, side, ceil_mode=True, count_include_pad=False)
    skeleton = torch.zeros_like(cells)
    for _ in range(max(cells.shape[2:]) // 2 + 1):
        eroded = -_largest_around(-cells)
        removed = (cells - _largest_around(eroded)).relu()
        skeleton, cells = skeleton + removed * (1 - skeleton), eroded
    spread = skeleton.repeat_interleave(side, 2).repeat_interleave(side, 3) / side
    return spread[..., :height, :width]


def _largest_around(layers: Tensor) -> Tensor:
    """The largest value in the 3 x 3 pixels around each pixel, inside the image."""
    return F.max_pool2d(layers, 3, 1, 1)
