"""Gray pictures: from colour, and of another size."""

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

    Bilinear between pixel centres, in integers: weights are parts of 2048 and low bits are cut off
    on the way, so that values are up to 0.75 below the exact ones before rounding. Where the
    picture shrinks, pixels between the samples do not count.
    """
    up, down, to_up, to_down = (tap.to(pictures.device) for tap in _taps(pictures.shape[1], height))
    left, right, to_left, to_right = (
        tap.to(pictures.device) for tap in _taps(pictures.shape[2], width)
    )
    wide = pictures.int()
    rows = wide[:, :, left] * to_left + wide[:, :, right] * to_right >> 4
    upper = rows[:, up] * to_up[:, None] >> 16
    lower = rows[:, down] * to_down[:, None] >> 16
    return (upper + lower + 2 >> 2).to(torch.uint8)


def _taps(before: int, after: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """For each place after resizing the two places before it, and their weights."""
    centres = torch.arange(after, dtype=torch.float64) + 0.5
    place = (centres * (before / after) - 0.5).float()
    first = place.floor()
    fraction = place - first
    weights = [(part * _WEIGHT_UNIT).round().int() for part in (1 - fraction, fraction)]
    places = [(first.long() + step).clamp(0, before - 1) for step in (0, 1)]
    return places[0], places[1], weights[0], weights[1]
