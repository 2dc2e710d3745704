"""Soft vanishing column: where the street narrows to, as a real number."""

from __future__ import annotations

import torch
from torch import Tensor

OPEN = (0, 1, 5)
"""Ground, sidewalk and sky."""

POWER = 8
PULL = 20
"""As in `vanishing_columns`: openness weighs by its eighth power, and the middle of the image as
much as a twentieth of all columns."""


def soft_vanishing_columns(layers: Tensor) -> Tensor:
    """How many columns right of the middle the street's vanishing column is, in each image.

    Args:
        layers: ``(B, K, h, w)``, 0 to 1.

    Returns:
        ``(B,)``, negative to the left; `vanishing_columns` rounds it.
    """
    width = layers.shape[3]
    openness = layers[:, OPEN].sum(1).clamp(max=1).mean(1)
    weight = openness**POWER
    from_middle = torch.arange(width).to(layers) - (width - 1) / 2
    return (weight @ from_middle) / (weight.sum(1) + width / PULL)
