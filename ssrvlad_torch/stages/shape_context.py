"""Shape context: where the points of a layer lie around a reference point, in exact integers."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image, count_groups
from .lengths import Length
from .tracing import MOST, number_in, repeat_while

PAIRS_AT_ONCE = 1 << 16
"""Most pairs of points in memory at a time, without those of the last reference point: a few
megabytes for any number of points."""

MOST_PAIRS = 4
"""Pairs of points for each offset of the table, up to which a list is faster than a correlation."""

_BASE = 512
_DIGITS = 5
"""Digits of a slope after the point: 45 bits."""


class Bins(NamedTuple):
    """The target-shaped template of the shape context, as a table over offsets.

    Attributes:
        table: ``(2H - 1, 2W - 1)`` int32. The entry at ``(dy + H - 1, dx + W - 1)`` is the bin of
            the offset ``(dy, dx)``, ``ring * M + sector``, or ``total`` for the reference point
            itself and for what is farther than the last ring.
        total: N * M, the number of bins.
    """

    table: Tensor
    total: int


def shape_contexts(
    references: Sequence[Points], context: Points, bins: Bins, images: int
) -> list[Tensor]:
    """Sums of the shape contexts around each layer's reference points, ``(B, 8, N * M)`` int64 for
    each entry of the references. Under export -1 for a layer of 2 ** 31 pairs or more.

    Around every reference point the context points of the same layer are counted by ring and
    sector; the reference point itself is not counted. Pairs are listed chunk by chunk. A layer with
    so many pairs that the list would take long is correlated with its reference points by Fourier
    transforms, at about 130 bytes of memory for each pixel.
    """
    sums = len(references)
    around, among = (_joined(lists, LAYERS * images) for lists in (references, [context] * sums))
    counts = _counts(around, among, bins, images * sums)
    return [by_image(count, images) for count in counts.unflatten(0, (sums, -1)).unbind()]


def _joined(lists: Sequence[Points], groups: int) -> Points:
    """One list, with groups of their own for every list."""
    group = torch.cat([points.group + groups * number for number, points in enumerate(lists)])
    y, x = (torch.cat(places) for places in zip(*(points[1:] for points in lists), strict=True))
    return Points(group, y, x)


def _counts(references: Points, context: Points, bins: Bins, images: int) -> Tensor:
    """``(8 * B, N * M)`` int64, the sums of `shape_contexts` for each group."""
    pitch = bins.table.shape[1]
    groups, stride = LAYERS * images, bins.total + 1
    context_position = context.y * pitch + context.x
    population, members = (count_groups(points, images) for points in (context, references))
    group_start = population.cumsum(0) - population
    reference_position = references.y * pitch + references.x - bins.table.numel() // 2
    if torch.compiler.is_exporting():
        positions = context_position, reference_position
        counts = _one_by_one(*positions, references.group, group_start, population, bins)
        too_many = population.float() * members.float() >= MOST  # some count in int32
        return torch.where(too_many[:, None], -1, counts.view(groups, stride)[:, : bins.total])
    counts = torch.zeros(groups * stride, dtype=torch.int64, device=bins.table.device)
    dense = population * members > MOST_PAIRS * bins.table.numel()
    for group in dense.nonzero()[:, 0].tolist():
        around, among = (_chosen(points, points.group == group) for points in (references, context))
        counts[group * stride : (group + 1) * stride] = _correlated(around, among, bins)
    listed = ~dense[references.group]
    references, reference_position = _chosen(references, listed), reference_position[listed]
    pairs = population[references.group]
    chunk = (pairs.cumsum(0) - pairs) // PAIRS_AT_ONCE
    for rows in torch.arange(len(pairs), device=pairs.device).split(torch.bincount(chunk).tolist()):
        group, count = references.group[rows], pairs[rows]
        pair_count = int(count.sum())
        owner = torch.repeat_interleave(count, output_size=pair_count)
        first = group_start[group] - (count.cumsum(0) - count)
        entry = first.index_select(0, owner) + torch.arange(pair_count, device=owner.device)
        offset = context_position.index_select(0, entry)
        offset -= reference_position[rows].index_select(0, owner)
        bin_index = (group * stride).index_select(0, owner)
        bin_index += bins.table.flatten().index_select(0, offset)
        counts += torch.bincount(bin_index, minlength=groups * stride)
    return counts.view(groups, stride)[:, : bins.total]


def _one_by_one(
    context: Tensor, references: Tensor, group: Tensor, start: Tensor, size: Tensor, bins: Bins
) -> Tensor:
    """Counts of each bin of each group, by a loop over the reference points."""
    stride = bins.total + 1

    def count(step: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        of = group[step]
        first, length = number_in(start[of]), number_in(size[of])
        torch._check(first + length <= context.shape[0])
        points = context.narrow(0, first, length) - references[step]
        entries = bins.table.flatten().index_select(0, points) + of * stride
        counts = counts.scatter_add(0, entries, torch.ones_like(entries))
        return (step + 1 < references.shape[0]).all(), step + 1, counts

    zeros = torch.zeros(start.shape[0] * stride, dtype=torch.int64)
    some = torch.full((), references.shape[0]) > 0
    return repeat_while(some, count, torch.zeros(1, dtype=torch.int64), zeros)[1]


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


def log_polar_bins(
    height: int, width: int, limits: Sequence[Length], sectors: int, device: torch.device
) -> Bins:
    """The template for images of one size. ``limits`` are the largest squared distances of the
    rings, innermost first; a boundary belongs to the ring inside it. Of M sectors, number ``m``
    covers the angles from ``2 pi m / M``, included, to ``2 pi (m + 1) / M``, excluded, counted from
    +x (right) towards +y (down)."""
    total = len(limits) * sectors
    dx = torch.arange(1 - width, width, device=device, dtype=torch.int32)
    dy = torch.arange(1 - height, height, device=device, dtype=torch.int32)[:, None]
    squared = dy * dy + dx * dx
    *beyond, outside = (squared - limit > 0 for limit in limits)  # some compare in float32
    bins = _sectors(dy, dx, sectors)
    for reached in beyond:
        bins = bins + reached.int() * sectors
    return Bins(torch.where(outside | (squared == 0), total, bins), total)


def _sectors(dy: Tensor, dx: Tensor, sectors: int) -> Tensor:
    """The sector of each offset. A boundary at angle a is crossed at dx = dy / tan(a); points on it
    are in the sector that begins there. Offsets above are turned by half a circle."""
    half, odd = divmod(sectors, 2)
    above = (dy < 0) | ((dy == 0) & (dx < 0))
    sector: Tensor = above.int() * half
    column = torch.where(above, -dx, dx)
    angles = [2 * math.pi * number / sectors for number in range(1, half + odd)]
    crossings = _crossings(dy.abs(), angles)
    if odd:
        turn = 2 * math.pi * half / sectors - math.pi
        turned = _crossings(dy.abs(), [angle + turn for angle in angles])
        crossings = torch.where(dy < 0, turned, crossings)
    for crossing in crossings.unbind():
        sector = sector + (column <= crossing).int()
    return sector


def _crossings(dy: Tensor, angles: Sequence[float]) -> Tensor:
    """dy / tan(angle) of each angle, rounded down, from digits to the base 512, whose products are
    exact in float32, in which some runtimes divide integers."""
    slopes = [round(math.cos(angle) / math.sin(angle) * _BASE**_DIGITS) for angle in angles]

    def times(digits: list[int]) -> Tensor:
        return dy * torch.tensor(digits, dtype=dy.dtype, device=dy.device).view(-1, 1, 1)

    carried = times([0] * len(slopes))
    for place in range(_DIGITS):
        carried = (times([slope // _BASE**place % _BASE for slope in slopes]) + carried) // _BASE
    return times([slope // _BASE**_DIGITS for slope in slopes]) + carried
