"""Centre of a layer: the centroid of its pixels (Eq. 1)."""

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image, runs, sums_of_groups
from .tracing import divided, real


def centroids(planes: Tensor) -> Points:
    """Centre of the pixels of each layer of bit-planes that has any, rounded to the nearest pixel,
    halves up (Eq. 1)."""
    segments, images = runs(planes), planes.shape[0]
    areas = sums_of_groups(segments.length, segments.group, images)
    group = areas.nonzero()[:, 0]
    area = areas.index_select(0, group)

    def mean(twice: Tensor) -> Tensor:
        """The mean of halves over the area, from sums of up to 2 ** 63."""
        weighted = twice * segments.length
        sums = sums_of_groups(weighted.to(real()), segments.group, images)
        estimate = sums.index_select(0, group) / area
        total = sums_of_groups(weighted, segments.group, images).index_select(0, group) + area
        return divided(total, 2 * area, (estimate + 1) / 2)[0]

    return Points(group, mean(2 * segments.y), mean(segments.first + segments.last))


def centre_table(centres: Points, images: int) -> Tensor:
    """``(B, 8, 2)`` int64 rows and columns of the centres, -1 for a layer without pixels."""
    table = torch.full((LAYERS * images, 2), -1, dtype=torch.int64, device=centres.group.device)
    table[centres.group] = torch.stack((centres.y, centres.x), -1)
    return by_image(table, images)
