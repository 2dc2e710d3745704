"""Keypoints: the end points and intersections of skeletons, as bit-planes."""

from torch import Tensor

from .bitplanes import neighbours, steps_around, two_or_more


def end_points(skeleton: Tensor) -> Tensor:
    """Skeleton pixels with one 8-neighbour, or none."""
    return skeleton & ~two_or_more(neighbours(skeleton))


def intersections(skeleton: Tensor) -> Tensor:
    """Skeleton pixels whose crossing number is 3 or more, one of each touching group.

    The crossing number counts the 0 -> 1 steps around the pixel (Rutovitz 1966). A pixel is
    dropped if another intersection pixel is W, NW, N or NE of it."""
    a, b, c, d = steps_around(neighbours(skeleton))
    crossing = skeleton & (a & b & (c | d) | c & d & (a | b))  # three of the four
    n, ne, *_, w, nw = neighbours(crossing)
    return crossing & ~(w | nw | n | ne)
