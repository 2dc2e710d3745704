"""Soft keypoints: the weight of each skeleton pixel as an end point and as an intersection."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def soft_keypoints(skeleton: Tensor) -> Tensor:
    """The weight of every pixel as a keypoint of its layer.

    Args:
        skeleton: ``(B, 8, h, w)``, 0 to 1.

    Returns:
        ``(B, 8, h, w)``, 0 to 1: end points and intersections together.
    """
    ends, crossings = soft_end_points(skeleton), soft_intersections(skeleton)
    return ends + crossings - ends * crossings


def soft_end_points(skeleton: Tensor) -> Tensor:
    """The pixel's weight if its neighbours sum to 1 or less, falling to 0 at a sum of 2."""
    total = torch.zeros_like(skeleton)
    for neighbour in _neighbours(skeleton):
        total = total + neighbour
    return skeleton * (2 - total).clamp(0, 1)


def soft_intersections(skeleton: Tensor) -> Tensor:
    """The pixel's weight if there are three or more steps around it, 0 for two or fewer.

    A step is the product of a neighbour being off and the next one being on. The weight is smaller
    if an earlier pixel, W, NW, N or NE, is an intersection too.
    """
    ring = _neighbours(skeleton)
    steps = torch.zeros_like(skeleton)
    for neighbour, following in zip(ring, [*ring[1:], ring[0]], strict=True):
        steps = steps + (1 - neighbour) * following
    crossing = skeleton * (steps - 2).clamp(0, 1)
    north, north_east, *_, west, north_west = _neighbours(crossing)
    return crossing * (1 - west) * (1 - north_west) * (1 - north) * (1 - north_east)


def _neighbours(skeleton: Tensor) -> list[Tensor]:
    """N, NE, E, SE, S, SW, W, NW of every pixel; outside the image is 0."""
    height, width = skeleton.shape[2:]
    padded = F.pad(skeleton, (1, 1, 1, 1))
    offsets = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))
    return [padded[..., y : y + height, x : x + width] for y, x in offsets]
