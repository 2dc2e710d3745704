"""Aggregation: residuals to the centre's histogram, layer by layer (Eq. 2), and concatenation."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor


def aggregate(point_sums: Tensor, centres: Tensor, point_counts: Tensor) -> Tensor:
    """The descriptor of each image.

    Args:
        point_sums: ``(B, K, N * M)`` int64, sum of the key-points' histograms of each layer.
        centres: ``(B, K, N * M)`` int64, histogram around each layer's centre.
        point_counts: ``(B, K)`` int64, number of key-points of each layer.

    Returns:
        ``(B, K * N * M)`` float32: the layer vectors, each of length 1 or exactly zero, put one
        after another and normalised; exact zeros for an image in which every layer is zero.
    """
    residuals = point_sums - point_counts[..., None] * centres  # Eq. 2, numerator
    layers = F.normalize(residuals.double(), dim=-1)  # Eq. 2; zeros stay zeros
    return F.normalize(layers.flatten(1), dim=-1).float()
