"""Shape context as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...bitplanes import LAYERS
from ...stages.shape_context import PAIRS_AT_ONCE
from ..graph import Graph, Symbol
from ..words import GraphPoints, Grid, by_image_in_graph

Step = tuple[Symbol, Symbol, Symbol]
"""Columns and rows from the reference point, and the change of the bin there, int32."""

_BASE = 512
_DIGITS = 5
"""Digits of a slope after the point: 45 bits. A digit times a row is exact in float32."""

_FAR = 1 << 20


class GraphBins(NamedTuple):
    """`Bins` in a graph, for any number of sectors.

    Attributes:
        table: ``(n,)`` int32, the bins, column after column.
        pitch: ``()`` int32, rows of a column, 2H - 1.
        centre: ``()`` int32, the index of the reference point.
        total: the number of bins, N * M.
    """

    table: Symbol
    pitch: Symbol
    centre: Symbol
    total: int


def shape_contexts_in_graph(
    graph: Graph, references: GraphPoints, context: GraphPoints, bins: GraphBins, images: Symbol
) -> Symbol:
    """`shape_contexts` in a graph. Each step of the loop takes a block of references of one layer,
    and all context points of the layer."""
    groups, stride = images * LAYERS, bins.total + 1
    context_index = context.x * bins.pitch + context.y
    reference_index = references.x * bins.pitch + references.y - bins.centre
    population, members = (graph.counts(points.group, groups) for points in (context, references))
    at_once = PAIRS_AT_ONCE // graph.Max(population, 1) + 1
    group, step = graph.repeated((members + at_once - 1) // at_once)
    first, last = graph.exclusive_sums(members), graph.exclusive_sums(members) + members
    begin = first.take(group) + step * at_once.take(group)
    end = graph.Min(begin + at_once.take(group), last.take(group))
    context_begin = graph.exclusive_sums(population)
    context_end = context_begin + population

    def count(step: Symbol, counts: Symbol) -> list[Symbol]:
        layer = group[step]
        origins = reference_index[begin[step] : end[step]].reshape(-1, 1)
        points = context_index[context_begin[layer] : context_end[layer]]
        of_pairs = bins.table.take((points - origins).reshape(-1))
        row = graph.counts(of_pairs, stride).reshape(1, -1)
        index = layer.to("int64").reshape(1, 1)
        return [graph.ScatterND(counts, index, row, reduction="add")]

    zeros = graph.full([groups, stride], 0, "int32")
    (counts,) = graph.repeat(graph.length(group), count, zeros, rank=2)
    return by_image_in_graph(graph, graph.Slice(counts, [0], [bins.total], [1]), images)


def too_many_in_graph(
    graph: Graph, references: GraphPoints, context: GraphPoints, images: Symbol
) -> Symbol:
    """``()`` bool, whether a count of `shape_contexts_in_graph` could reach 2 ** 31."""
    counts = [
        graph.counts(points.group, images * LAYERS).to("float32")
        for points in (references, context)
    ]
    return graph.any(counts[0] * counts[1] >= float(1 << 31))


def log_polar_bins_in_graph(
    graph: Graph, grid: Grid, limits: Symbol, rings: int, sectors: int
) -> GraphBins:
    """`log_polar_bins` in a graph.

    Along a row dy the bin changes where a ring ends and where a sector begins. These columns are
    computed in whole numbers, and the changes are summed along the row.
    """
    height, width = grid.height, grid.width
    pitch, middle, total = height * 2 - 1, width - 1, rings * sectors
    steps = [
        *_ring_steps(graph, height, limits, rings, sectors),
        *_sector_steps(graph, height, sectors),
    ]
    indices, changes = [], []
    for x, y, change in steps:
        column = graph.Max(graph.Min(x + middle, width * 2 - 1), 0)
        index = column * pitch + y + (height - 1)
        indices.append(index.reshape(-1))
        changes.append(graph.Expand(change, graph.Shape(index)).reshape(-1))
    index, amounts = graph.Concat(*indices, axis=0), graph.Concat(*changes, axis=0)
    summed = graph.sums(index, amounts, pitch * width * 2).reshape(-1, pitch)
    table = graph.Min(graph.CumSum(summed, 0), total)
    return GraphBins(table.reshape(-1), pitch, middle * pitch + height - 1, total)


def _ring_steps(
    graph: Graph, height: Symbol, limits: Symbol, rings: int, sectors: int
) -> list[Step]:
    """Steps at the ends of rings. Far left, and at the reference point, no ring is entered yet."""
    dy = (graph.arange(height * 2 - 1) - (height - 1)).reshape(-1, 1)
    squared = limits - dy * dy
    reach = graph.Sqrt(graph.Max(squared, 0).to("float32")).to("int32")
    reach = reach + (squared - (reach + 1) * (reach + 1) >= 0).to("int32")
    reach = reach - (squared - reach * reach < 0).to("int32")
    change = (squared >= 0).to("int32") * sectors
    origin = graph.full([1, 1], 0, "int32")
    total = graph.full([1, 1], rings * sectors, "int32")
    return [
        (origin - _FAR, dy, total),
        (reach * -1, dy, change * -1),
        (reach + 1, dy, change),
        (origin, origin, total),
        (origin + 1, origin, total * -1),
    ]


def _sector_steps(graph: Graph, height: Symbol, sectors: int) -> list[Step]:
    """Steps at the boundaries of sectors. A boundary at angle a is crossed at dx = dy / tan(a);
    points on it are in the sector that begins there."""
    half, odd = divmod(sectors, 2)
    lines = half + odd - 1
    dy = graph.arange(height).reshape(-1, 1)
    origin = graph.full([1, 1], 0, "int32")
    one = graph.full([1, 1], 1, "int32")
    steps: list[Step] = [
        (origin - _FAR, dy, one * lines),
        (origin - _FAR, dy[1:] * -1, one * half),
        (origin - _FAR, origin, one * (half - lines)),
        (origin + 1, origin, one * (lines - half)),
    ]
    if lines:
        below = _crossings(graph, dy, [2 * np.pi * b / sectors for b in range(1, lines + 1)])
        above = _crossings(
            graph, dy[1:], [2 * np.pi * (b + half) / sectors - np.pi for b in range(1, lines + 1)]
        )
        steps += [(below + 1, dy, one * -1), (above * -1, dy[1:] * -1, one)]
    return steps


def _crossings(graph: Graph, dy: Symbol, angles: Sequence[float]) -> Symbol:
    """``(n, angles)`` int32, dy / tan(angle) rounded down, from digits to the base 512."""
    slopes = np.round(np.cos(angles) / np.sin(angles) * _BASE**_DIGITS).astype(np.int64)
    digits = [slopes // _BASE**_DIGITS]
    digits += [slopes // _BASE**place % _BASE for place in reversed(range(_DIGITS))]
    whole, *parts = (graph.constant(digit.astype(np.int32)) * dy for digit in digits)
    carried = parts[-1] // _BASE
    for part in reversed(parts[:-1]):
        carried = (part + carried) // _BASE
    return whole + carried
