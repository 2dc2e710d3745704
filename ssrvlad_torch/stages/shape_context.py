"""Shape context: where the points of a layer lie around a reference point, in exact integers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..bitplanes import LAYERS, Points, by_image
from ..deployment.graph import Graph, Symbol
from ..deployment.words import GraphPoints, by_image_in_graph

PAIRS_AT_ONCE = 1 << 16
"""Pairs of points in memory at a time, and those of one reference point more: some megabytes,
however many points there are."""


ROWS_AT_ONCE = 64
"""Rows of the table of bins that are made at a time."""

OFFSETS_AT_ONCE = 1 << 14
"""Entries of the table that a graph makes at a time, and those of one row more."""

_STEPS = 512
"""Steps of a quarter of a turn, finer than 360 sectors a turn are."""


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
    sector; the reference point itself is not counted. Pairs are listed chunk by chunk.

    Args:
        references: the points around which is counted.
        context: the points that are counted.
        bins: from `log_polar_bins`, for the size of the image.
        images: B.

    Returns:
        ``(B, 8, N * M)`` int64.
    """
    pitch = bins.table.shape[1]
    groups, stride = LAYERS * images, bins.total + 1
    context_place = context.y * pitch + context.x
    reference_place = references.y * pitch + references.x - bins.table.numel() // 2
    population = torch.bincount(context.group, minlength=groups)
    group_start = population.cumsum(0) - population
    pairs = population[references.group]
    chunk = (pairs.cumsum(0) - pairs) // PAIRS_AT_ONCE
    counts = torch.zeros(groups * stride, dtype=torch.int64, device=bins.table.device)
    for part in torch.arange(len(pairs), device=pairs.device).split(torch.bincount(chunk).tolist()):
        group, count = references.group[part], pairs[part]
        pair_count = int(count.sum())
        owner = torch.repeat_interleave(count, output_size=pair_count)
        first = group_start[group] - (count.cumsum(0) - count)
        seen = first.index_select(0, owner) + torch.arange(pair_count, device=owner.device)
        offset = context_place.index_select(0, seen)
        offset -= reference_place[part].index_select(0, owner)
        place = (group * stride).index_select(0, owner)
        place += bins.table.flatten().index_select(0, offset)
        counts += torch.bincount(place, minlength=groups * stride)
    return by_image(counts.view(groups, stride)[:, : bins.total], images)


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
        device: where the table lies.
    """
    total = len(limits) * sectors
    table = torch.empty((2 * height - 1, 2 * width - 1), dtype=torch.int16, device=device)
    dx = torch.arange(1 - width, width, device=device)
    rows = torch.arange(1 - height, height, device=device)[:, None]
    for part, dy in zip(table.split(ROWS_AT_ONCE), rows.split(ROWS_AT_ONCE), strict=True):
        squared = dy * dy + dx * dx
        ring = sum((squared > limit).to(torch.int64) for limit in limits)
        sector = _twelve_sectors(dy, dx) if sectors == 12 else _sectors(dy, dx, sectors)
        inside = (squared > 0) & (squared <= limits[-1])
        part.copy_(torch.where(inside, ring * sectors + sector, total))
    return Bins(table, total)


def _twelve_sectors(dy: Tensor, dx: Tensor) -> Tensor:
    """Sectors of 30 degrees by integer comparisons: the tangents of 30 and 60 degrees are the
    square roots of 1/3 and 3. In two of the quarters the slope falls as the angle grows."""
    y, x = dy * dy, dx * dx
    rise = (3 * y > x).to(torch.int64) + (y > 3 * x)
    quarter = torch.where(dy > 0, (dx <= 0).to(torch.int64), 2 + (dx >= 0).to(torch.int64))
    quarter = torch.where(dy == 0, torch.where(dx < 0, 2, 0), quarter)
    return 3 * quarter + torch.where(quarter % 2 == 0, rise, 2 - rise)


def _sectors(dy: Tensor, dx: Tensor, sectors: int) -> Tensor:
    """Sectors of any number. Integer offsets meet a boundary only at multiples of 45 degrees;
    every other offset is farther from one than the nudge, which is above the rounding error."""
    turn = torch.atan2(dy.double(), dx.double()) / (2 * torch.pi)
    return torch.floor(turn * sectors + 1e-12).to(torch.int64) % sectors


class GraphBins(NamedTuple):
    """`Bins` in a graph, for any number of sectors.

    Attributes:
        table: ``(n,)`` int32, the table row after row, and perhaps some more.
        pitch: ``()`` int64, 2W - 1.
        centre: ``()`` int64, the place of the reference point.
        total: N * M.
    """

    table: Symbol
    pitch: Symbol
    centre: Symbol
    total: int


def shape_contexts_in_graph(
    graph: Graph, references: GraphPoints, context: GraphPoints, bins: GraphBins, images: Symbol
) -> Symbol:
    """`shape_contexts` in a graph: a block of one layer's references at a time, each of them with
    all its context points."""
    groups, stride = images * LAYERS, bins.total + 1
    context_place = context.y * bins.pitch + context.x
    reference_place = references.y * bins.pitch + references.x - bins.centre
    population, members = (graph.counts(listed.group, groups) for listed in (context, references))
    at_once = PAIRS_AT_ONCE // graph.Max(population, 1) + 1
    group, step = graph.repeated((members + at_once - 1) // at_once)
    first, last = graph.before(members), graph.before(members) + members
    begin = first.take(group) + step * at_once.take(group)
    end = graph.Min(begin + at_once.take(group), last.take(group))
    context_begin = graph.before(population)
    context_end = context_begin + population

    def count(step: Symbol, counts: Symbol) -> list[Symbol]:
        own = group[step]
        around = reference_place[begin[step] : end[step]].reshape(-1, 1)
        seen = context_place[context_begin[own] : context_end[own]]
        found = bins.table.take((seen - around).reshape(-1))
        row = graph.counts(found, stride).reshape(1, -1)
        return [graph.ScatterND(counts, own.reshape(1, 1), row, reduction="add")]

    zeros = graph.full([groups, stride], 0, "int64")
    (counts,) = graph.repeat(graph.Size(group), count, zeros)
    return by_image_in_graph(graph, graph.Slice(counts, [0], [bins.total], [1]), images)


def log_polar_bins_in_graph(
    graph: Graph, height: Symbol, width: Symbol, limits: Sequence[Symbol], sectors: int
) -> GraphBins:
    """`log_polar_bins` in a graph, some rows of the table at a time.

    The angle itself is not computed: y / (|x| + |y|) grows with it through each quarter, and its
    rounding error is as far below the nudge.
    """
    pitch, total = width * 2 - 1, len(limits) * sectors
    rows = OFFSETS_AT_ONCE // pitch + 1
    dx = graph.arange(pitch) - (width - 1)
    left = (dx < 0).to("float64")
    starts, guess = (graph.constant(table) for table in _sector_tables(sectors))

    def some_rows(step: Symbol) -> list[Symbol]:
        dy = (graph.arange(rows) + step * rows - (height - 1)).reshape(-1, 1)
        squared = dy * dy + dx * dx
        ring = (squared > limits[0]).to("int32")
        for limit in limits[1:]:
            ring = ring + (squared > limit).to("int32")
        length = graph.Max(graph.Abs(dy) + graph.Abs(dx), 1)
        turn = _turn(dy.to("float64") / length.to("float64"), left, (dy < 0).to("float64"))
        sector = guess.take((turn * _STEPS).to("int32").reshape(-1))
        next_start = starts.take(sector + 1).reshape(rows, -1)
        sector = sector.reshape(rows, -1) + (turn >= next_start).to("int32")
        inside = (squared > 0) & (squared <= limits[-1])
        return [graph.Where(inside, ring * sectors + sector, total)]

    (table,) = graph.stacked((height * 2 - 1 + rows - 1) // rows, some_rows)
    return GraphBins(table.reshape(-1), pitch, (height - 1) * pitch + width - 1, total)


def _sector_tables(sectors: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """The turn at which each sector starts, and the sector at each of the steps of a turn.

    Sectors are wider than steps, so there is at most one start between two steps.
    """
    angles = 2 * np.pi * np.arange(1, sectors) / sectors
    y, x = np.sin(angles), np.cos(angles)
    starts = _turn(y / (abs(y) + abs(x)), (x < 0) * 1.0, (y < 0) * 1.0) - 1e-12
    starts = np.concatenate(([0.0], starts, [np.inf]))
    steps = np.arange(4 * _STEPS) / _STEPS
    return starts, (np.searchsorted(starts, steps, side="right") - 1).astype(np.int32)


def _turn(rise: Any, left: Any, up: Any) -> Any:
    """0 to 4 once around, from y / (|x| + |y|) and from 1.0 where x, and y, are negative."""
    return rise * (1.0 - 2.0 * left) + 2.0 * left + 4.0 * (1.0 - left) * up
