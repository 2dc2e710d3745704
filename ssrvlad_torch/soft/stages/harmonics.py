"""Soft harmonics: the coefficients of the basis functions, with roots that are safe at zero."""

from __future__ import annotations

import math

from torch import Tensor

FAINT = 1e-3
"""Fraction of a bin, below which a root is a straight line."""

LEAST = 0.1
"""A descriptor that is far shorter before it is normalised, some hundredths of one layer's, is
that of an image in which next to nothing is seen."""


def soft_coefficients(
    area: Tensor,
    skeleton: Tensor,
    skeleton_weight: float,
    bins: Tensor,
    basis: Tensor,
    power: float,
) -> Tensor:
    """The descriptor of each image: the coefficients of its histograms in the basis.

    Args:
        area, skeleton: ``(B, 8, rows, columns)`` from `soft_pool`, the latter in sides of a cell.
        skeleton_weight, bins, basis, power: as for `soft_histograms` and `coefficients`.

    Returns:
        ``(B, 8 * harmonics)`` of length 1 at most; zeros for an image without layers.
    """
    covered, lengths = (safe_root(cells.flatten(2) @ bins.T) for cells in (area, skeleton))
    found = (covered + skeleton_weight * lengths) @ basis.T
    damping = (found.square() + FAINT * FAINT) ** ((power - 1) / 2)
    damped: Tensor = (found * damping).flatten(1)
    return damped / (damped.square().sum(1, keepdim=True) + LEAST * LEAST).sqrt()


def safe_root(fractions: Tensor) -> Tensor:
    """The square root from 0 on with a finite slope at 0."""
    return fractions / ((fractions + FAINT).sqrt() + math.sqrt(FAINT))
