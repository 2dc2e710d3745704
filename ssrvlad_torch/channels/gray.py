"""Gray pictures: conversion from colour, and resizing. In integers of at most 24 bits, so that a
graph gives the same numbers on every runtime."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .channel import View, picture_of

_LUMA = (19595, 38470, 7471)
"""Weights of red, green and blue, parts of 65536."""
_PARTS = 2048


def grays(views: Sequence[View], channel: str) -> Tensor:
    """``(B, H, W)`` uint8, the luma of views of one size, see `luma`; errors of `picture_of`."""
    return luma(torch.from_numpy(np.stack([picture_of(view, channel) for view in views])))


def luma(pictures: Tensor) -> Tensor:
    """``(B, H, W)`` uint8, the luma (ITU-R BT.601) of pictures ``(B, H, W, 3)`` uint8 in RGB, as
    Pillow rounds it."""
    red, green, blue = pictures.int().unbind(3)
    sums = red * _LUMA[0] + green * _LUMA[1] + blue * _LUMA[2]
    return ((sums + 32768) // 65536).to(torch.uint8)


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
    rows = (wide[:, :, left] * left_weight + wide[:, :, right] * right_weight) // 16
    upper = _weighed(rows[:, up], up_weight[:, None])
    lower = _weighed(rows[:, down], down_weight[:, None])
    return ((upper + lower + 2) // 4).to(torch.uint8)


def _weighed(rows: Tensor, weight: Tensor) -> Tensor:
    """``rows * weight // 65536`` for rows below 2 ** 15, without a number of more than 24 bits."""
    high, low = rows // 128, rows % 128
    return (high * weight + low * weight // 128) // 512


def _taps(before: int, after: int, device: torch.device) -> list[tuple[Tensor, Tensor]]:
    """The two source positions of each position after resizing, each with its weight. Positions are
    rounded to float32."""
    halves = 2 * torch.arange(after, dtype=torch.int32, device=device) + 1
    position = (halves * before - after).float() / (2 * after)
    first = position.floor()
    return [
        ((first.long() + step).clamp(0, before - 1), (weight * _PARTS).round().int())
        for step, weight in enumerate((1 - (position - first), position - first))
    ]
