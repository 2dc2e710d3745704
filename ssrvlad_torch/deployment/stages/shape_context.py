"""Shape context as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...bitplanes import LAYERS
from ...stages.shape_context import PAIRS_AT_ONCE
from ..graph import Graph, Symbol
from ..words import GraphPoints, by_image_in_graph

OFFSETS_AT_ONCE = 1 << 14
"""Entries of the table of bins that are made at a time, and those of one row more."""

_STEPS = 512
"""Steps of a quarter of a turn, finer than 360 sectors a turn are."""


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
