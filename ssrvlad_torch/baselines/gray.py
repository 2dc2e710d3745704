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
    """Luma of ITU-R BT.601, rounded; the same integers as Pillow's mode ``L``.

    Args:
        images: ``(B, H, W, 3)`` uint8, RGB.

    Returns:
        ``(B, H, W)`` uint8.
    """
    parts = images.to(torch.int32) * torch.tensor(_LUMA, dtype=torch.int32, device=images.device)
    return (parts.sum(-1, dtype=torch.int32) + (1 << 15) >> 16).to(torch.uint8)


def grays(frames: Sequence[Frame], method: str) -> Tensor:
    """``(B, H, W)`` uint8, the gray pictures of frames whose images are of one size.

    Raises:
        ValueError: a frame has no image; see `image_of`.
    """
    return gray(torch.from_numpy(np.stack([image_of(frame, method) for frame in frames])))


def resize(pictures: Tensor, height: int, width: int) -> Tensor:
    """Bilinear interpolation between pixel centres in integers, as OpenCV's ``INTER_LINEAR``.

    Weights are parts of 2048 and low bits are cut off on the way, so that the values are those
    of OpenCV for 8 bits, up to 0.75 below the exact ones before rounding. Where the picture
    shrinks, pixels between the samples are passed over.

    Args:
        pictures: ``(B, H, W)`` uint8.
        height, width: of the result.

    Returns:
        ``(B, height, width)`` uint8.
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
