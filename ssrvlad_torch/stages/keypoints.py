"""Key-points: the end points and intersections of the skeletons."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from ..bitplanes import Bits, neighbours, steps_around, two_or_more
from ..deployment.graph import Graph
from ..deployment.words import Words, neighbourhood


def end_points(skeleton: Tensor) -> Tensor:
    """Skeleton pixels with one 8-neighbour, or none.

    Args:
        skeleton: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    return skeleton & ~two_or_more(neighbours(skeleton))


def intersections(skeleton: Tensor) -> Tensor:
    """Skeleton pixels whose crossing number is 3 or more, one of each touching group.

    The crossing number counts the 0 -> 1 steps around the pixel (Rutovitz 1966). A pixel is
    dropped if another intersection pixel stands W, NW, N or NE of it.

    Args:
        skeleton: ``(B, H, W)`` uint8 bit-planes.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    crossing = skeleton & _three_or_more(steps_around(neighbours(skeleton)))
    height, width = skeleton.shape[-2:]
    padded = F.pad(crossing, (1, 1, 1, 0))
    west, above = padded[:, 1:, :width], padded[:, :height]
    earlier = west | above[..., :width] | above[..., 1 : width + 1] | above[..., 2:]
    return crossing & ~earlier


def end_points_in_graph(graph: Graph, skeleton: Words) -> Words:
    """`end_points` in a graph."""
    pixels, ring = neighbourhood(graph, skeleton)
    return skeleton.with_line(pixels & ~two_or_more(ring))


def intersections_in_graph(graph: Graph, skeleton: Words) -> Words:
    """`intersections` in a graph."""
    pixels, ring = neighbourhood(graph, skeleton)
    crossing = pixels & _three_or_more(steps_around(ring))
    north, north_east, *_, west, north_west = neighbourhood(graph, skeleton.with_line(crossing))[1]
    return skeleton.with_line(crossing & ~(west | north_west | north | north_east))


def _three_or_more(planes: Sequence[Bits]) -> Bits:
    """Bits that are set in at least three of four planes."""
    a, b, c, d = planes
    return a & b & (c | d) | c & d & (a | b)
