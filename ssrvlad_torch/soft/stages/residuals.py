"""Soft aggregation: residuals of each layer, normalised (Eq. 2); nearly empty ones stay short."""

from __future__ import annotations

from torch import Tensor

FAINT = 1.0
"""Pairs of points: a layer with a much shorter residual counts almost nothing."""

LEAST = 0.01
"""Layers: the descriptor of an image with much fewer keeps a length below 1."""


def soft_aggregate(residuals: Tensor) -> Tensor:
    """The descriptor of each image.

    Args:
        residuals: ``(B, 8, N * M)``, the numerators of Eq. 2.

    Returns:
        ``(B, 8 * N * M)`` of length 1 at most; zeros for an image without layers.
    """
    layers = residuals / _length(residuals, FAINT)  # Eq. 2
    descriptor = layers.flatten(1)
    return descriptor / _length(descriptor, LEAST)


def _length(vector: Tensor, least: float) -> Tensor:
    """The length of vectors, bounded from below: ``sqrt(length ** 2 + least ** 2)``."""
    return (vector.square().sum(-1, keepdim=True) + least * least).sqrt()
