"""Shape context: where the points of a layer lie around a reference point, in exact integers."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .bitplanes import LAYERS, Points, by_image, count_groups, repeated
from .lengths import Length
from .tracing import MOST, exporting, number_in, repeat_while

PAIRS_AT_ONCE = 1 << 16
"""Most pairs of points in memory at a time, without those of the last reference point: a few
megabytes for any number of points."""

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


def shape_contexts(references: Points, context: Points, bins: Bins, images: int) -> Tensor:
    """Sums of the shape contexts around each layer's reference points, ``(B, 8, N * M)`` int64.
    Under export -1 for a layer of 2 ** 31 pairs or more.

    Around every reference point the context points of the same layer are counted by ring and
    sector; the reference point itself is not counted. Pairs are listed chunk by chunk."""
    pitch = bins.table.shape[1]
    groups, stride = LAYERS * images, bins.total + 1
    context_position = context.y * pitch + context.x
    population, members = (count_groups(points, images) for points in (context, references))
    group_start = population.cumsum(0) - population
    reference_position = references.y * pitch + references.x - bins.table.numel() // 2
    if exporting():
        positions = context_position, reference_position
        counts = _one_by_one(*positions, references.group, group_start, population, bins)
        too_many = population.float() * members.float() >= MOST  # some count in int32
        counts = torch.where(too_many[:, None], -1, counts.view(groups, stride))
        return by_image(counts[:, : bins.total], images)
    counts = torch.zeros(groups * stride, dtype=torch.int64, device=bins.table.device)
    pairs = population[references.group]
    chunk = (pairs.cumsum(0) - pairs) // PAIRS_AT_ONCE
    for rows in torch.arange(len(pairs), device=pairs.device).split(torch.bincount(chunk).tolist()):
        # pairs have consecutive numbers: from that of the first of a reference point, its place in
        # the list of context points follows
        group, count = references.group[rows], pairs[rows]
        owner, number = repeated(count)
        offset = context_position.index_select(
            0, group_start[group].index_select(0, owner) + number
        )
        offset -= reference_position[rows].index_select(0, owner)
        bin_index = (group * stride).index_select(0, owner)
        bin_index += bins.table.flatten().index_select(0, offset)
        counts += torch.bincount(bin_index, minlength=groups * stride)
    return by_image(counts.view(groups, stride)[:, : bins.total], images)


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
    has_points = torch.full((), references.shape[0]) > 0
    return repeat_while(has_points, count, torch.zeros(1, dtype=torch.int64), zeros)[1]


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
