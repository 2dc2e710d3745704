"""Soft boundaries: how likely a boundary of any layer is at each pixel, by direction."""

import torch
import torch.nn.functional as F
from torch import Tensor


def soft_boundaries(layers: Tensor) -> Tensor:
    """``(B, 4, h, w)``, 0 to 1, the weight of each direction, upright, level, rising, falling, at
    every pixel of layers ``(B, K, h, w)``, 0 to 1, as if neighbours were independent."""
    if min(layers.shape[2:]) < 3:
        return torch.zeros_like(layers[:, :4])
    ends = slice(None, -2), slice(2, None)
    a, b, c, d = (layers[..., y, x] for y in ends for x in ends)
    by_layer = (
        _one_pair(a * c, b * d, (1 - a) * (1 - c), (1 - b) * (1 - d)),
        _one_pair(a * b, c * d, (1 - a) * (1 - b), (1 - c) * (1 - d)),
        _odd(a, b * c * d, (1 - b) * (1 - c) * (1 - d))
        + _odd(d, a * b * c, (1 - a) * (1 - b) * (1 - c)),
        _odd(b, a * c * d, (1 - a) * (1 - c) * (1 - d))
        + _odd(c, a * b * d, (1 - a) * (1 - b) * (1 - d)),
    )
    of_any = [1 - (1 - weight).prod(1) for weight in by_layer]
    return F.pad(torch.stack(of_any, 1), (1, 1, 1, 1))


def _one_pair(first: Tensor, second: Tensor, not_first: Tensor, not_second: Tensor) -> Tensor:
    """The weight of exactly one of two pairs being in the layer, the other outside."""
    return first * not_second + second * not_first


def _odd(corner: Tensor, others: Tensor, no_other: Tensor) -> Tensor:
    """The weight of one corner differing from the three others."""
    return corner * no_other + (1 - corner) * others
