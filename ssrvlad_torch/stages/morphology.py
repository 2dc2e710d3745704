"""Morphology: dilation, erosion, opening and closing of all layers at once by a square."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from .tracing import repeat_while


def dilate(planes: Tensor, radius: int | Tensor) -> Tensor:
    """Dilation by a square of ``2 * radius + 1`` pixels; outside the image is background.

    The semantics are those of ``skimage.morphology.dilation(mode="ignore")``.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        radius: pixels, 0 for no change; ``()`` int32 under export.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    if isinstance(radius, int):
        return _spread(_spread(planes, radius, -1), radius, -2)

    def by_one_pixel(planes: Tensor, left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return left > 1, dilate(planes, 1), left - 1

    return repeat_while(radius > 0, by_one_pixel, planes, radius)[0]


def erode(planes: Tensor, radius: int | Tensor) -> Tensor:
    """Erosion by a square; pixels outside the image are ignored, so the border erodes nothing.

    The semantics are those of ``skimage.morphology.erosion(mode="ignore")``.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        radius: pixels, 0 for no change; ``()`` int32 under export.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    return ~dilate(~planes, radius)


def open_and_close(planes: Tensor, opening: int | Tensor, closing: int | Tensor) -> Tensor:
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
