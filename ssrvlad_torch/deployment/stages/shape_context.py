"""Shape context as ONNX operators."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...stages.bitplanes import LAYERS
from ...stages.shape_context import PAIRS_AT_ONCE
from ..graph import Graph, Symbol
from ..words import GraphPoints, Grid, by_image_in_graph

_BASE = 512
_DIGITS = 5
"""Digits of a slope after the point: 45 bits. A digit times a row is exact in float32."""


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
    """`log_polar_bins` in a graph. Squares are compared by their differences, because some runtimes
    compare int32 in float32."""
    height, width = grid.height, grid.width
    pitch, total = height * 2 - 1, rings * sectors
    dy = (graph.arange(pitch) - (height - 1)).reshape(1, -1)
    dx = (graph.arange(width * 2 - 1) - (width - 1)).reshape(-1, 1)
    squared = dy * dy + dx * dx
    *beyond, outside = (squared - limits[number] > 0 for number in range(rings))
    ring = sum(each.to("int32") for each in beyond)
    bins = _sectors(graph, dy, dx, sectors) + ring * sectors
    table = graph.Where(outside | squared.equals(0), total, bins)
    return GraphBins(table.reshape(-1), pitch, (width - 1) * pitch + height - 1, total)


def _sectors(graph: Graph, dy: Symbol, dx: Symbol, sectors: int) -> Symbol:
    """The sector of each offset. A boundary at angle a is crossed at dx = dy / tan(a); points on it
    are in the sector that begins there. Offsets above are turned by half a circle."""
    half, odd = divmod(sectors, 2)
    above = (dy < 0) | (dy.equals(0) & (dx < 0))
    sector, column = above.to("int32") * half, graph.Where(above, dx * -1, dx)
    if half + odd == 1:
        return sector
    angles = 2 * np.pi * np.arange(1, half + odd) / sectors
    row = graph.Abs(dy).reshape(-1, 1)
    crossings = _crossings(graph, row, angles)
    if odd:
        turned = _crossings(graph, row, angles + 2 * np.pi * half / sectors - np.pi)
        crossings = graph.Where(dy.reshape(-1, 1) < 0, turned, crossings)
    for crossing in graph.split(crossings, len(angles), axis=1):
        sector = sector + (column <= crossing.reshape(1, -1)).to("int32")
    return sector


def _crossings(graph: Graph, dy: Symbol, angles: npt.NDArray[np.float64]) -> Symbol:
    """``(n, angles)`` int32, dy / tan(angle) rounded down, from digits to the base 512."""
    slopes = np.round(np.cos(angles) / np.sin(angles) * _BASE**_DIGITS).astype(np.int64)
    digits = [slopes // _BASE**_DIGITS]
    digits += [slopes // _BASE**place % _BASE for place in reversed(range(_DIGITS))]
    whole, *parts = (graph.constant(digit.astype(np.int32)) * dy for digit in digits)
    carried = parts[-1] // _BASE
    for part in reversed(parts[:-1]):
        carried = (part + carried) // _BASE
    return whole + carried
