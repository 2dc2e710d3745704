"""Morphology: dilation, erosion, opening and closing of all layers at once by a square."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def dilate(planes: Tensor, radius: int) -> Tensor:
    """Dilation by a square of ``2 * radius + 1`` pixels; outside the image is background.

    The semantics are those of ``skimage.morphology.dilation(mode="ignore")``.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        radius: pixels, 0 for no change.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    for dimension in (-1, -2):
        planes = _spread(planes, radius, dimension)
    return planes


def erode(planes: Tensor, radius: int) -> Tensor:
    """Erosion by a square; pixels outside the image are ignored, so the border erodes nothing.

    The semantics are those of ``skimage.morphology.erosion(mode="ignore")``.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        radius: pixels, 0 for no change.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    return ~dilate(~planes, radius) if radius else planes


def open_and_close(planes: Tensor, opening: int, closing: int) -> Tensor:
    """Opening, which removes parts thinner than the square, then closing, which fills such gaps.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        opening, closing: radii in pixels, 0 for none.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    opened = dilate(erode(planes, opening), opening)
    return erode(dilate(opened, closing), closing)


def _spread(planes: Tensor, radius: int, dimension: int) -> Tensor:
    """Running OR over ``2 * radius + 1`` pixels of one dimension; each step doubles the reach."""
    if radius == 0:
        return planes
    size = planes.shape[dimension]
    margins = (radius, radius) if dimension == -1 else (0, 0, radius, radius)
    window, reach = F.pad(planes, margins), 1
    while reach < 2 * radius + 1:
        step = min(reach, 2 * radius + 1 - reach)
        length = window.shape[dimension] - step
        window = window.narrow(dimension, 0, length) | window.narrow(dimension, step, length)
        reach += step
    return window.narrow(dimension, 0, size)
