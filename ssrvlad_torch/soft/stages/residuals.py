"""Soft aggregation: residuals of each layer, normalised where there is something (Eq. 2)."""

from __future__ import annotations

from torch import Tensor

FAINT = 1.0
"""Pairs of points: a layer whose residual is far shorter counts as if it were not there."""

LEAST = 0.01
"""Layers: an image of far fewer is one in which next to nothing is seen."""


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
    """The length of vectors, and of one that is ``least`` and at right angles to them."""
    return (vector.square().sum(-1, keepdim=True) + least * least).sqrt()
