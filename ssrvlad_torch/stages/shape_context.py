"""Shape context: where the points of a layer lie around a reference point, in exact integers."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image

PAIRS_AT_ONCE = 1 << 16
"""Most pairs of points in memory at a time, not counting those of the last reference point: a few
megabytes for any number of points."""

MOST_PAIRS = 4
"""Pairs of points for each offset of the table; of more, a correlation is faster than a list."""

ROWS_AT_ONCE = 64
"""Rows of the table of bins that are computed at a time."""


class Bins(NamedTuple):
    """The target-shaped template of the shape context, as a table over offsets.

    Attributes:
        table: ``(2H - 1, 2W - 1)`` int16. The entry at ``(dy + H - 1, dx + W - 1)`` is the bin of
            the offset ``(dy, dx)``, ``ring * M + sector``, or ``total`` for the reference point
            itself and for what is farther than the last ring.
        total: N * M, the number of bins.
    """

    table: Tensor
    total: int


def shape_contexts(references: Points, context: Points, bins: Bins, images: int) -> Tensor:
    """Sum of the shape contexts around each layer's reference points.

    Around every reference point the context points of the same layer are counted by ring and
    sector; the reference point itself is not counted. Pairs are listed chunk by chunk. A layer with
    so many pairs that the list would take long is correlated with its reference points by Fourier
    transforms, at about 130 bytes of memory for each pixel.

    Args:
        references: the centres of the histograms.
        context: the points to count.
        bins: from `log_polar_bins`, for the size of the image.
        images: B.

    Returns:
        ``(B, 8, N * M)`` int64.
    """
    pitch = bins.table.shape[1]
    groups, stride = LAYERS * images, bins.total + 1
    context_position = context.y * pitch + context.x
    population = torch.bincount(context.group, minlength=groups)
    group_start = population.cumsum(0) - population
    counts = torch.zeros(groups * stride, dtype=torch.int64, device=bins.table.device)
    sums = population * torch.bincount(references.group, minlength=groups)
    dense = sums > MOST_PAIRS * bins.table.numel()
    for group in dense.nonzero()[:, 0].tolist():
        around, among = (_chosen(each, each.group == group) for each in (references, context))
        counts[group * stride : (group + 1) * stride] = _correlated(around, among, bins)
    references = _chosen(references, ~dense[references.group])
    reference_position = references.y * pitch + references.x - bins.table.numel() // 2
    pairs = population[references.group]
    chunk = (pairs.cumsum(0) - pairs) // PAIRS_AT_ONCE
    for part in torch.arange(len(pairs), device=pairs.device).split(torch.bincount(chunk).tolist()):
        group, count = references.group[part], pairs[part]
        pair_count = int(count.sum())
        owner = torch.repeat_interleave(count, output_size=pair_count)
        first = group_start[group] - (count.cumsum(0) - count)
        entry = first.index_select(0, owner) + torch.arange(pair_count, device=owner.device)
        offset = context_position.index_select(0, entry)
        offset -= reference_position[part].index_select(0, owner)
        bin_index = (group * stride).index_select(0, owner)
        bin_index += bins.table.flatten().index_select(0, offset)
        counts += torch.bincount(bin_index, minlength=groups * stride)
    return by_image(counts.view(groups, stride)[:, : bins.total], images)


def _correlated(references: Points, context: Points, bins: Bins) -> Tensor:
    """``(N * M + 1,)`` int64, the number of pairs of points of one layer in each bin.

    The number of pairs of each offset is a correlation. In float64 its rounding error is far below
    one half for images of up to 2 ** 28 pixels, so the rounded numbers are exact.
    """
    height, width = ((length + 1) // 2 for length in bins.table.shape)
    spectra = []
    for points in (references, context):
        image = torch.zeros(height, width, dtype=torch.float64, device=bins.table.device)
        image[points.y, points.x] = 1
        spectra.append(torch.fft.rfft2(image, (2 * height, 2 * width)))
    pairs = torch.fft.irfft2(spectra[1] * spectra[0].conj(), (2 * height, 2 * width))
    pairs = pairs.roll((height - 1, width - 1), (0, 1))[: 2 * height - 1, : 2 * width - 1]
    counts = torch.zeros(bins.total + 1, dtype=torch.int64, device=pairs.device)
    return counts.index_add_(0, bins.table.flatten().long(), pairs.round().long().flatten())


def _chosen(points: Points, which: Tensor) -> Points:
    return Points(*(column[which] for column in points))


@lru_cache(maxsize=8)
def log_polar_bins(
    height: int, width: int, limits: tuple[int, ...], sectors: int, device: torch.device
) -> Bins:
    """The template for images of one size.

    Args:
        height, width: size of the image.
        limits: largest squared distance of each ring, innermost first; a boundary belongs to the
            ring inside it.
        sectors: M. Sector ``m`` covers the angles from ``2 pi m / M``, included, to
            ``2 pi (m + 1) / M``, excluded, counted from +x (right) towards +y (down).
        device: of the table.
    """
    total = len(limits) * sectors
    table = torch.empty((2 * height - 1, 2 * width - 1), dtype=torch.int16, device=device)
    dx = torch.arange(1 - width, width, device=device)
    rows = torch.arange(1 - height, height, device=device)[:, None]
    for part, dy in zip(table.split(ROWS_AT_ONCE), rows.split(ROWS_AT_ONCE), strict=True):
        squared = dy * dy + dx * dx
        ring = sum((squared > limit).to(torch.int64) for limit in limits)
        sector = _sectors(dy, dx, sectors)
        inside = (squared > 0) & (squared <= limits[-1])
        part.copy_(torch.where(inside, ring * sectors + sector, total))
    return Bins(table, total)


def _sectors(dy: Tensor, dx: Tensor, sectors: int) -> Tensor:
    """The sector of each offset. Integer offsets lie on a boundary only at multiples of 45 degrees;
    all others are farther from it than the added 1e-12, which is above the rounding error."""
    turn = torch.atan2(dy.double(), dx.double()) / (2 * torch.pi)
    return torch.floor(turn * sectors + 1e-12).to(torch.int64) % sectors
