"""Centre of a layer: the centroid of its pixels (Eq. 1)."""

from __future__ import annotations

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image, runs
from .tracing import divided, real


def centroids(planes: Tensor) -> Points:
    """Centre of each layer's pixels, rounded to the nearest pixel, halves up (Eq. 1).

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        One point for each layer that has pixels.
    """
    segments = runs(planes)
    length = segments.last - segments.first + 1

    def sums(amounts: Tensor) -> Tensor:
        zeros = amounts.new_zeros(LAYERS * planes.shape[0])
        return zeros.scatter_add(0, segments.group, amounts)

    areas = sums(length)
    group = areas.nonzero()[:, 0]
    area = areas.index_select(0, group)

    def mean(twice: Tensor) -> Tensor:
        """The mean of halves over the area, from sums of up to 2 ** 63."""
        weighted = twice * length
        estimate = sums(weighted.to(real())).index_select(0, group) / area
        total = sums(weighted).index_select(0, group) + area
        return divided(total, (estimate + 1) / 2, 2 * area)[0]

    return Points(group, mean(2 * segments.y), mean(segments.first + segments.last))


def centre_table(centres: Points, count: int) -> Tensor:
    """``(B, 8, 2)`` int64 rows and columns of the centres, -1 for a layer without pixels."""
    table = torch.full((LAYERS * count, 2), -1, dtype=torch.int64, device=centres.group.device)
    table[centres.group] = torch.stack((centres.y, centres.x), -1)
    return by_image(table, count)
