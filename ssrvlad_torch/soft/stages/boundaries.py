"""Soft boundaries: how likely a boundary of some layer runs past a pixel, by direction."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def soft_boundaries(layers: Tensor) -> Tensor:
    """The weight of each direction at every pixel, as if neighbours were independent.

    Args:
        layers: ``(B, K, h, w)``, 0 to 1.

    Returns:
        ``(B, 4, h, w)``, 0 to 1: upright, level, rising, falling.
    """
    if min(layers.shape[2:]) < 3:
        return torch.zeros_like(layers[:, :4])
    ends = slice(None, -2), slice(2, None)
    a, b, c, d = (layers[..., y, x] for y in ends for x in ends)
    found = (
        _parted(a * c, b * d, (1 - a) * (1 - c), (1 - b) * (1 - d)),
        _parted(a * b, c * d, (1 - a) * (1 - b), (1 - c) * (1 - d)),
        _odd(a, b * c * d, (1 - b) * (1 - c) * (1 - d))
        + _odd(d, a * b * c, (1 - a) * (1 - b) * (1 - c)),
        _odd(b, a * c * d, (1 - a) * (1 - c) * (1 - d))
        + _odd(c, a * b * d, (1 - a) * (1 - b) * (1 - d)),
    )
    of_any = [1 - (1 - each).prod(1) for each in found]
    return F.pad(torch.stack(of_any, 1), (1, 1, 1, 1))


def _parted(here: Tensor, there: Tensor, not_here: Tensor, not_there: Tensor) -> Tensor:
    return here * not_there + there * not_here


def _odd(corner: Tensor, others: Tensor, no_other: Tensor) -> Tensor:
    return corner * no_other + (1 - corner) * others
