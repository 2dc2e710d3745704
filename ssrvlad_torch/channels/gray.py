"""Gray pictures: conversion from colour, and resizing."""

from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from .channel import View, picture_of

_WEIGHT_UNIT = 2048


def grays(views: Sequence[View], channel: str) -> Tensor:
    """``(B, H, W)`` uint8, the luma (ITU-R BT.601) of views of one size; errors of `picture_of`."""
    pictures = [Image.fromarray(picture_of(view, channel)).convert("L") for view in views]
    return torch.from_numpy(np.stack([np.asarray(picture) for picture in pictures]))


def resize(pictures: Tensor, height: int, width: int) -> Tensor:
    """``(B, H, W)`` uint8 pictures at another size, as OpenCV's ``INTER_LINEAR`` for 8 bits.

    It is bilinear between pixel centres, in integers: weights are parts of 2048 and low bits are
    dropped, so values are up to 0.75 below the exact ones before rounding. If the picture shrinks,
    pixels between the samples do not count.
    """
    device = pictures.device
    (up, up_weight), (down, down_weight) = _taps(pictures.shape[1], height, device)
    (left, left_weight), (right, right_weight) = _taps(pictures.shape[2], width, device)
    wide = pictures.int()
    rows = wide[:, :, left] * left_weight + wide[:, :, right] * right_weight >> 4
    upper = rows[:, up] * up_weight[:, None] >> 16
    lower = rows[:, down] * down_weight[:, None] >> 16
    return (upper + lower + 2 >> 2).to(torch.uint8)


def _taps(before: int, after: int, device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """The two source positions of each position after resizing, each with its weight."""
    centres = torch.arange(after, dtype=torch.float64, device=device) + 0.5
    position = (centres * (before / after) - 0.5).float()
    first = position.floor()
    return [
        ((first.long() + step).clamp(0, before - 1), (weight * _WEIGHT_UNIT).round().int())
        for step, weight in enumerate((1 - (position - first), position - first))
    ]
