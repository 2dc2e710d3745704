"""Soft skeleton: iterated soft erosion and opening, held together by the thinned one.

The skeleton of Shit et al., clDice, CVPR 2021, has a gradient at every pixel, but on a street's
layers it falls into pieces: what is counted around its end points has little to do with what the
method counts. The pixels that the hard thinning keeps make the other part; there the layer itself
is what is differentiated.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

COARSE = 48
"""Largest shorter side of the grid on which is eroded; above it, pixels are averaged in squares."""


def soft_skeleton(layers: Tensor, thinned: Tensor, softness: float) -> Tensor:
    """The weight of every pixel in the skeleton of its layer.

    Args:
        layers: ``(B, 8, h, w)`` clean layers, 0 to 1.
        thinned: ``(B, 8, h, w)`` bool, the skeleton of the hard layers.
        softness: fraction of the eroded skeleton in it, from 0, the hard skeleton where the layers
            are 0 and 1, to 1.

    Returns:
        ``(B, 8, h, w)``, 0 to 1.
    """
    kept = layers * thinned
    if not softness:
        return kept
    eroded: Tensor = checkpoint(eroded_skeleton, layers, use_reentrant=False)
    return kept + softness * (eroded - kept)


def eroded_skeleton(layers: Tensor) -> Tensor:
    """The soft skeleton of Shit et al.: what an opening removes, of the layers as they erode.

    It is made on a grid of at most `COARSE` rows or columns and spread over the pixels of each
    cell so that lengths stay the same. Half the grid's longer side is how often it is eroded: no
    more is left of what lies inside the image.

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
        found = (cells - _largest_around(eroded)).relu()
        skeleton, cells = skeleton + found * (1 - skeleton), eroded
    spread = skeleton.repeat_interleave(side, 2).repeat_interleave(side, 3) / side
    return spread[..., :height, :width]


def _largest_around(layers: Tensor) -> Tensor:
    """The largest value in the 3 x 3 pixels around; outside the image is ignored."""
    return F.max_pool2d(layers, 3, 1, 1)
