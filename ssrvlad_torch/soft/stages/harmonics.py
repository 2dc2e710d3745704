"""Soft harmonics: the coefficients of the basis functions, with roots of finite slope at zero."""

import math

import torch
from torch import Tensor

FAINT = 1e-3
"""Fraction of a bin below which a root is nearly a straight line."""

LEAST = 0.1
"""The length that a descriptor needs before normalisation: a much shorter one, of an image that
shows almost no category, keeps a length below 1."""


def soft_coefficients(
    area: Tensor,
    lengths: Tensor,
    bins: Tensor,
    basis: Tensor,
    numbers: tuple[int, int],
    power: float,
) -> Tensor:
    """The descriptor of each image, ``(B, 6 * numbers[0] + 4 * numbers[1])`` of length 1 at most:
    the coefficients of its histograms in the basis, of ``area`` ``(B, 6, rows, columns)`` and
    ``lengths`` ``(B, 4, rows, columns)``, in sides of a cell, from `soft_pool`; `bin_table`,
    `basis_table`, how many coefficients each area and each direction has, and the power are those
    of `Harmonics`."""
    parts = [
        (safe_root(cells.flatten(2) @ bins.T) @ basis[:number].T).flatten(1)
        for cells, number in zip((area, lengths), numbers, strict=True)
    ]
    coefficients = torch.cat(parts, 1)
    damped = coefficients * (coefficients.square() + FAINT * FAINT) ** ((power - 1) / 2)
    return damped / (damped.square().sum(1, keepdim=True) + LEAST * LEAST).sqrt()


def safe_root(fractions: Tensor) -> Tensor:
    """The square root of numbers from 0, with a finite slope at 0."""
    return fractions / ((fractions + FAINT).sqrt() + math.sqrt(FAINT))
