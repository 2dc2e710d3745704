"""Regions of a convolutional layer with the highest energy (Khaliq et al., T-RO 2019).

A region is a set of 8-connected places of one feature map with one level of activation, and its
energy is its mean activation. The level is the integer part, and level 0 is no region: the paper
groups activations that are not zero, but the authors' program gives the real-valued map to
scikit-image's ``label``, which cuts the fractions off, and their vocabulary was trained on what
came out. The program is followed.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_FORWARD = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Steps down and right to the four of a place's eight neighbours that come after it."""


def region_descriptors(maps: Tensor, count: int) -> Tensor:
    """The aggregated descriptors of the regions with the highest energy.

    A descriptor is the sum of the local descriptors, the columns through all maps, over the
    region's bounding box. Of regions with equal energy the one in the earlier map, then the one
    that starts further up, then left, comes first.

    Args:
        maps: ``(C, H, W)`` float activations that are not negative.
        count: N, the most regions to take.

    Returns:
        ``(R, C)`` float32 by falling energy; R is below ``count`` where there are fewer regions.
    """
    channel, y, x = (maps >= 1).nonzero(as_tuple=True)
    regions, number = _first_places(maps.int())[channel, y, x].unique(return_inverse=True)
    size = torch.zeros(len(regions), dtype=torch.float64, device=maps.device)
    energy = torch.zeros_like(size).index_add_(0, number, maps[channel, y, x].double())
    energy /= size.index_add_(0, number, torch.ones_like(energy)[number])
    best = energy.sort(descending=True, stable=True).indices[:count]
    top, bottom = (_extreme(y, number, len(regions), way)[best] for way in ("amin", "amax"))
    left, right = (_extreme(x, number, len(regions), way)[best] for way in ("amin", "amax"))
    sums = F.pad(maps.double().cumsum(1).cumsum(2), (1, 0, 1, 0))
    boxes = sums[:, bottom + 1, right + 1] + sums[:, top, left]
    boxes -= sums[:, top, right + 1] + sums[:, bottom + 1, left]
    return boxes.mT.float()


def _first_places(levels: Tensor) -> Tensor:
    """For each place the lowest index of the places of its region.

    The index passes between neighbours of one level, and on to all that took the neighbour's,
    until nothing changes.
    """
    index = torch.arange(levels.numel(), device=levels.device).reshape(levels.shape)
    pairs = [_neighbours(levels, index, *step) for step in _FORWARD]
    one, other = (torch.cat(side) for side in zip(*pairs, strict=True))
    lowest = index.flatten()
    while True:
        least = lowest[one].minimum(lowest[other])
        passed = lowest.scatter_reduce(0, one, least, "amin")
        passed = passed.scatter_reduce(0, other, least, "amin")
        passed = passed[passed]
        if torch.equal(passed, lowest):
            return lowest.reshape(levels.shape)
        lowest = passed


def _neighbours(levels: Tensor, index: Tensor, down: int, right: int) -> tuple[Tensor, Tensor]:
    """Indices of places and of the places one step on, where both have one level above 0."""
    height, width = levels.shape[1:]
    here = (..., slice(height - down), slice(max(0, -right), width - max(0, right)))
    there = (..., slice(down, None), slice(max(0, right), width + min(0, right)))
    alike = (levels[here] == levels[there]) & (levels[here] > 0)
    return index[here][alike], index[there][alike]


def _extreme(values: Tensor, number: Tensor, count: int, way: str) -> Tensor:
    """The lowest or highest value of each group."""
    start = values.new_zeros(count)
    return start.scatter_reduce(0, number, values, way, include_self=False)
