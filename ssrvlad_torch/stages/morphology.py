"""Morphology: dilation, erosion, opening and closing of all layers at once by a square of
``2 * radius + 1`` pixels; radius 0 changes nothing."""

import torch
import torch.nn.functional as F
from torch import Tensor

from .lengths import Length
from .tracing import repeat_while


def dilate(planes: Tensor, radius: int) -> Tensor:
    """Dilation; outside the image is background, as in
    ``skimage.morphology.dilation(mode="ignore")``."""
    return _spread(_spread(planes, radius, -1), radius, -2)


def erode(planes: Tensor, radius: int) -> Tensor:
    """Erosion; pixels outside the image are ignored, so the border erodes nothing, as in
    ``skimage.morphology.erosion(mode="ignore")``."""
    return ~dilate(~planes, radius)


def open_and_close(planes: Tensor, opening: Length, closing: Length) -> Tensor:
    """Opening, which removes parts thinner than the square, then closing, which fills such gaps, by
    their radii, ``()`` int32 under export."""
    return _close(~_close(~planes, opening), closing)


def _close(planes: Tensor, radius: Length) -> Tensor:
    if isinstance(radius, int):
        return erode(dilate(planes, radius), radius)

    def dilate_by_one(planes: Tensor, left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        planes = torch.where(left == radius, ~planes, planes)  # erosion begins
        return left > 1, dilate(planes, 1), left - 1

    eroded = ~repeat_while(radius > 0, dilate_by_one, planes, 2 * radius)[0]
    return torch.where(radius > 0, eroded, planes)


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
