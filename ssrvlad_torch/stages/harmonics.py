"""Harmonics: one soft shape context around the vista, told by its smooth patterns.

The paper's N log-spaced rings and M sectors are laid around one point, with soft bins: a cell
counts in the two nearest rings and the two nearest sectors. Boundaries then cost nothing, and
what moves a little changes the counts a little. Not in the paper.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

_SAMPLES = 4
"""Points on each side of a cell at which the bins are evaluated."""


def soft_histograms(area: Tensor, skeleton: Tensor, skeleton_weight: float, bins: Tensor) -> Tensor:
    """What stands in every bin of every layer.

    The square root of the share of the bin that the layer covers, plus the weighted square root
    of the length of its skeleton there, per cell and in sides of a cell. The root is Hellinger's:
    much of a layer must not drown little of another.

    Args:
        area: ``(B, 8, rows, columns)`` float64, the share of each cell that a layer covers.
        skeleton: likewise, lengths of their skeletons.
        skeleton_weight: 0 or more.
        bins: `bin_table`.

    Returns:
        ``(B, 8, N * M)`` float64.
    """
    shares, lengths = (area.flatten(2) @ bins.T).sqrt(), (skeleton.flatten(2) @ bins.T).sqrt()
    return shares + skeleton_weight * lengths


def amounts(histogram: Tensor, patterns: Tensor, power: float) -> Tensor:
    """The descriptor of each image: how much of each pattern its histograms hold.

    Args:
        histogram: ``(B, 8, N * M)`` float64 from `soft_histograms`.
        patterns: `pattern_table`.
        power: to which the size of every number is raised, its sign kept.

    Returns:
        ``(B, 8 * harmonics)`` float32 of length 1; exact zeros for an image without layers.
    """
    held = histogram @ patterns.T
    damped = (held.sign() * held.abs() ** power).flatten(1)
    return F.normalize(damped, dim=1).float()


def bin_table(
    cells: tuple[int, int], rings: int, sectors: int, radius: float, inner_radius: float
) -> Tensor:
    """The mean over each bin as a matrix over rows and columns of cells.

    Ring ``n`` is centred on ``radius * inner_radius ** (1 - n / (N - 1))`` of the
    diagonal, sector ``m`` on the angle ``2 pi m / M`` from +x towards +y. Between two centres,
    on the logarithmic scale and the angular, a cell counts in both, linearly. What is nearer
    than the first ring counts in it; what is farther than ``radius`` is not counted.

    Returns:
        ``(N * M, rows * columns)`` float64; a row sums to 1, or to 0 for a bin without cells.
    """
    y, x = ((torch.arange(n * _SAMPLES).double() + 0.5) / _SAMPLES - n / 2 for n in cells)
    distance = torch.hypot(y[:, None], x[None]) / math.hypot(*cells)
    turn = torch.atan2(y[:, None], x[None]) / (2 * math.pi)
    steps = torch.log(distance / radius) / math.log(1 / inner_radius) if inner_radius < 1 else -1
    ring = torch.as_tensor((rings - 1) * (1 + steps)).expand_as(distance).clamp(0, rings - 1)
    weight = _tents(ring, rings, False)[:, None] * _tents(turn % 1 * sectors, sectors, True)[None]
    weight = (weight * (distance <= radius)).flatten(0, 1)
    samples = weight.unflatten(2, (cells[1], _SAMPLES)).unflatten(1, (cells[0], _SAMPLES))
    return F.normalize(samples.sum((2, 4)).flatten(1), p=1, dim=1)


def pattern_table(rings: int, sectors: int, harmonics: int, sharpening: float) -> Tensor:
    """The smoothest patterns over the bins: a cosine over the rings times a wave over the sectors.

    A pattern that changes ``u / 2`` times over the rings and ``v`` times around has frequency
    ``f ** 2 = u ** 2 + v ** 2``. They come by rising ``f``, then ``u``, then ``v``, the cosine
    before the sine, each of length ``(1 + f ** 2) ** (sharpening / 2)``: coarse patterns, which
    all streets share, weigh less than fine ones.

    Returns:
        ``(harmonics, N * M)`` float64.
    """
    ring = torch.arange(rings).double()[:, None] + 0.5
    turn = torch.arange(sectors).double()[None] * (2 * math.pi / sectors)
    patterns = []
    for u, v, phase in waves(rings, sectors)[:harmonics]:
        wave = torch.cos(math.pi * u * ring / rings) * torch.cos(v * turn - phase)
        patterns.append(wave.flatten() / wave.norm() * (1 + u * u + v * v) ** (sharpening / 2))
    return torch.stack(patterns)


def waves(rings: int, sectors: int) -> list[tuple[int, int, float]]:
    """Frequency over the rings, around, and phase of every pattern, in their order."""
    around = [(v, phase) for v in range((sectors + 1) // 2) for phase in (0.0, math.pi / 2)]
    every = [(u, v, phase) for u in range(rings) for v, phase in around[:1] + around[2:]]
    return sorted(every, key=lambda wave: (wave[0] ** 2 + wave[1] ** 2, *wave))


def _tents(position: Tensor, count: int, around: bool) -> Tensor:
    """``(count, H, W)``: 1 where the position is the index, falling to 0 at its neighbours."""
    distance = (position - torch.arange(count).double().view(-1, 1, 1)).abs()
    tents = (1 - distance).clamp(min=0)
    return tents + (1 - (count - distance)).clamp(min=0) if around else tents
