"""Soft harmonics: the amounts of the smooth patterns, with roots that are safe at zero."""

from __future__ import annotations

import math

from torch import Tensor

FAINT = 1e-3
"""Share of a bin, below which a root is a straight line."""

LEAST = 0.1
"""A descriptor that is far shorter before it is normalised, some hundredths of one layer's, is
that of an image in which next to nothing is seen."""


def soft_amounts(
    area: Tensor,
    skeleton: Tensor,
    skeleton_weight: float,
    bins: Tensor,
    patterns: Tensor,
    power: float,
) -> Tensor:
    """The descriptor of each image: how much of each pattern its histograms hold.

    Args:
        area, skeleton: ``(B, 8, rows, columns)`` from `soft_shares`, the latter in sides of a cell.
        skeleton_weight, bins, patterns, power: as for `soft_histograms` and `amounts`.

    Returns:
        ``(B, 8 * harmonics)`` of length 1 at most; zeros for an image without layers.
    """
    covered, lengths = (safe_root(cells.flatten(2) @ bins.T) for cells in (area, skeleton))
    held = (covered + skeleton_weight * lengths) @ patterns.T
    damping = (held.square() + FAINT * FAINT) ** ((power - 1) / 2)
    damped: Tensor = (held * damping).flatten(1)
    return damped / (damped.square().sum(1, keepdim=True) + LEAST * LEAST).sqrt()


def safe_root(shares: Tensor) -> Tensor:
    """The square root from 0 on with a finite slope at 0."""
    return shares / ((shares + FAINT).sqrt() + math.sqrt(FAINT))
