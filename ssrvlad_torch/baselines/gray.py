"""Gray pictures: conversion from colour, and resizing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .protocol import Frame, image_of

_LUMA = (19595, 38470, 7471)
"""Red, green and blue in parts of 1 << 16 (ITU-R BT.601)."""

_WEIGHT_UNIT = 2048


def gray(images: Tensor) -> Tensor:
    """``(B, H, W)`` uint8 luma (ITU-R BT.601) of RGB pictures ``(B, H, W, 3)`` uint8, rounded to
    the same integers as Pillow's mode ``L``."""
    parts = images.to(torch.int32) * torch.tensor(_LUMA, dtype=torch.int32, device=images.device)
    return (parts.sum(-1, dtype=torch.int32) + (1 << 15) >> 16).to(torch.uint8)


def grays(frames: Sequence[Frame], method: str) -> Tensor:
    """``(B, H, W)`` uint8, the gray pictures of frames of one size; for errors see `image_of`."""
    return gray(torch.from_numpy(np.stack([image_of(frame, method) for frame in frames])))


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
