"""Gray pictures: from colour, and of another size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .protocol import Frame, image_of

_LUMA = (19595, 38470, 7471)
"""Red, green and blue in parts of 1 << 16 (ITU-R BT.601)."""


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
    """Bilinear interpolation between pixel centres, within one gray value of OpenCV's.

    Where the picture shrinks, pixels between the samples are passed over.

    Args:
        pictures: ``(B, H, W)`` uint8.
        height, width: of the result.

    Returns:
        ``(B, height, width)`` uint8.
    """
    wide = pictures[:, None].float()
    return F.interpolate(wide, (height, width), mode="bilinear")[:, 0].round().to(torch.uint8)
