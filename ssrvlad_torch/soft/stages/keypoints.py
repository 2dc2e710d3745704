"""Soft keypoints: how much of an end point and of an intersection each skeleton pixel is."""

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
    """The pixel's weight while its neighbours sum to 1 at most; nothing from 2 on."""
    beside = torch.zeros_like(skeleton)
    for neighbour in _neighbours(skeleton):
        beside = beside + neighbour
    return skeleton * (2 - beside).clamp(0, 1)


def soft_intersections(skeleton: Tensor) -> Tensor:
    """The pixel's weight from three steps around it on, less where an earlier pixel has it.

    A step is a neighbour that is off before one that is on, their product; none up to two steps.
    Earlier are the pixels W, NW, N and NE.
    """
    ring = _neighbours(skeleton)
    steps = torch.zeros_like(skeleton)
    for here, there in zip(ring, [*ring[1:], ring[0]], strict=True):
        steps = steps + (1 - here) * there
    crossing = skeleton * (steps - 2).clamp(0, 1)
    north, north_east, *_, west, north_west = _neighbours(crossing)
    return crossing * (1 - west) * (1 - north_west) * (1 - north) * (1 - north_east)


def _neighbours(skeleton: Tensor) -> list[Tensor]:
    """N, NE, E, SE, S, SW, W, NW of every pixel; outside the image is 0."""
    height, width = skeleton.shape[2:]
    padded = F.pad(skeleton, (1, 1, 1, 1))
    offsets = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))
    return [padded[..., y : y + height, x : x + width] for y, x in offsets]
