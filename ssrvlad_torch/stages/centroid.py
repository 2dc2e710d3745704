"""Centre of a layer: the centroid of its pixels (Eq. 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image, runs


def centroids(planes: Tensor) -> Points:
    """Centre of each layer's pixels, rounded to the nearest pixel, halves up (Eq. 1).

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        One point for each layer that has pixels.
    """
    segments = runs(planes)
    length = segments.last - segments.first + 1
    sums = length.new_zeros((3, LAYERS * len(planes)))
    sums[0].index_add_(0, segments.group, length)
    sums[1].index_add_(0, segments.group, segments.y * length)
    sums[2].index_add_(0, segments.group, (segments.first + segments.last) * length // 2)
    group = sums[0].nonzero()[:, 0]
    area, sum_y, sum_x = sums[:, group]
    return Points(group, (2 * sum_y + area) // (2 * area), (2 * sum_x + area) // (2 * area))


def centre_table(centres: Points, count: int) -> Tensor:
    """``(B, 8, 2)`` int64 rows and columns of the centres, -1 for a layer without pixels."""
    table = torch.full((LAYERS * count, 2), -1, dtype=torch.int64, device=centres.group.device)
    table[centres.group] = torch.stack((centres.y, centres.x), -1)
    return by_image(table, count)
