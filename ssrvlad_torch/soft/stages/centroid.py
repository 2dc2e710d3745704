"""Soft centre of a layer: the weighted centroid of its pixels (Eq. 1)."""

from __future__ import annotations

import torch
from torch import Tensor

FAINT = 1e-3
"""Weight, in pixels, added to every layer in the middle of the image: an empty layer's centre."""


def soft_centroids(layers: Tensor) -> Tensor:
    """Rows and columns of the layers' centres (Eq. 1).

    Args:
        layers: ``(B, 8, h, w)``, 0 to 1.

    Returns:
        ``(B, 8, 2)``, not rounded; the middle of the image for an empty layer.
    """
    area = layers.sum((2, 3)) + FAINT
    return torch.stack([_mean(layers.sum(3), area), _mean(layers.sum(2), area)], -1)


def soft_points(centres: Tensor, height: int, width: int) -> Tensor:
    """A map of each centre: weight 1, spread bilinearly over the four pixels around it.

    Args:
        centres: ``(B, 8, 2)`` rows and columns inside the image.
        height, width: of the maps.

    Returns:
        ``(B, 8, height, width)``, 0 to 1.
    """
    rows, columns = (
        (1 - (torch.arange(size).to(centres) - centre[..., None]).abs()).clamp(min=0)
        for size, centre in zip((height, width), centres.unbind(-1), strict=True)
    )
    return rows[..., None] * columns[..., None, :]


def _mean(profile: Tensor, area: Tensor) -> Tensor:
    """``(B, 8)`` mean positions of the weights along a ``(B, 8, n)`` line."""
    position = torch.arange(profile.shape[-1]).to(profile)
    return (profile @ position + FAINT * (len(position) - 1) / 2) / area
