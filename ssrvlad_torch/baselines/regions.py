"""Regions of a convolutional layer with the highest energy (Khaliq et al., T-RO 2019).

A region is a set of 8-connected places of one feature map with the same integer part of the
activation, not 0; its energy is its mean activation. This follows the authors' program, which gives
the map to scikit-image's ``label`` and on which their vocabulary was trained; the paper groups
activations that are not zero. It needs the extra ``eval``.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..files import requiring


def region_descriptors(maps: Tensor, count: int) -> Tensor:
    """The aggregated descriptors ``(R, C)`` float32 of the at most ``count`` regions with the
    highest energy, by falling energy, of activations ``(C, H, W)`` float that are not negative.

    A descriptor is the sum of the local descriptors, the values of all maps at one place, over the
    region's bounding box. Regions with equal energy are in the order of their maps, then of their
    first places from top to bottom, then from left to right.
    """
    with requiring("eval", "region-vlad needs"):
        from skimage.measure import label
    levels = maps.numpy(force=True).astype(np.int64)
    apart = np.arange(len(levels))[:, None, None] * (levels.max(initial=0) + 1)  # maps do not join
    levels = np.where(levels > 0, levels + apart, 0)
    numbers, regions = label(levels, return_num=True, connectivity=3)  # in the order of the regions
    channel, y, x = (maps >= 1).nonzero(as_tuple=True)
    number = torch.from_numpy(numbers - 1).to(maps.device)[channel, y, x]
    size = torch.zeros(regions, dtype=torch.float64, device=maps.device)
    energy = torch.zeros_like(size).index_add_(0, number, maps[channel, y, x].double())
    energy /= size.index_add_(0, number, torch.ones_like(energy)[number])
    best = energy.sort(descending=True, stable=True).indices[:count]
    top, bottom = (_extreme(y, number, regions, way)[best] for way in ("amin", "amax"))
    left, right = (_extreme(x, number, regions, way)[best] for way in ("amin", "amax"))
    sums = F.pad(maps.double().cumsum(1).cumsum(2), (1, 0, 1, 0))
    boxes = sums[:, bottom + 1, right + 1] + sums[:, top, left]
    boxes -= sums[:, top, right + 1] + sums[:, bottom + 1, left]
    return boxes.mT.float()


def _extreme(values: Tensor, number: Tensor, count: int, way: str) -> Tensor:
    """The lowest or highest value of each group."""
    start = values.new_zeros(count)
    return start.scatter_reduce(0, number, values, way, include_self=False)
