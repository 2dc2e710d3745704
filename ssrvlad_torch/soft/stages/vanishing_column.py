"""Soft vanishing column: the column towards which the street narrows, as a real number."""

import torch
from torch import Tensor

OPEN = (0, 1, 5)
"""Ground, sidewalk and sky."""

POWER = 8
PULL = 20
"""As in `vanishing_columns`: the weight of a column is the eighth power of its open fraction, and
the middle of the image has the weight of a twentieth of all columns, fully open."""


def soft_vanishing_columns(layers: Tensor) -> Tensor:
    """``(B,)``, how many columns right of the middle the vanishing column of layers ``(B, K, h,
    w)``, 0 to 1, is, negative to the left; `vanishing_columns` rounds it."""
    width = layers.shape[3]
    open_fraction = layers[:, OPEN].sum(1).clamp(max=1).mean(1)
    weight = open_fraction**POWER
    from_middle = torch.arange(width).to(layers) - (width - 1) / 2
    return (weight @ from_middle) / (weight.sum(1) + width / PULL)
