"""Reduction as ONNX operators."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol

_EXACT_BITS = 24
"""Whole numbers of so many bits are exact in float32."""


class _Cells(NamedTuple):
    """The cells of a side, int32: ``()`` pixels of it and of the longest cell, ``(cells,)`` the
    first pixel of each and how many it has."""

    pixels: Symbol
    longest: Symbol
    first: Symbol
    length: Symbol


def reduce_by_majority_in_graph(
    graph: Graph,
    entries: Symbol,
    table: npt.NDArray[np.uint8],
    size: tuple[Symbol, Symbol],
    grid: tuple[Symbol, Symbol],
) -> tuple[Symbol, Symbol]:
    """`reduce_by_majority` in a graph, for one image whose ids are not looked up yet.

    Most cells hold one id: the least and the largest of their ids are the same. Votes are counted
    in the others only.

    Args:
        graph: where the nodes go.
        entries: ``(H, W)`` uint8 or int32, for each pixel its entry in the table.
        table: ``(T,)`` uint8, 0 to 7, `NO_LAYER`, or above it for an unknown id, which votes as if
            it had no layer.
        size: H and W, ``()`` int32.
        grid: h and w, likewise.

    Returns:
        ``(h, w)`` uint8, and ``()`` int32, the number of unknown ids.
    """
    tall, wide = (_cells(graph, *lengths) for lengths in zip(size, grid, strict=True))
    lowest, highest = (
        _over_cells(graph, extreme, entries, tall, wide)
        for extreme in (graph.ReduceMin, graph.ReduceMax)
    )
    kind = graph.constant(table.astype(np.int32)).take(lowest)
    area = (tall.length.reshape(-1, 1) * wide.length).reshape(-1)
    mixed = graph.places(~lowest.equals(highest))
    seen, most = _entries_of(graph, entries, len(table), mixed, tall, wide)
    votes = _votes(graph, seen, table, most)
    rest = area.take(mixed).reshape(1, -1) - graph.ReduceSum(votes[:NO_LAYER], [0])
    ballot = graph.Concat(votes[:NO_LAYER], rest, axis=0)
    winner = graph.ArgMax(ballot, axis=0, keepdims=0).to("int32")
    categories = graph.ScatterElements(graph.Min(kind, NO_LAYER), mixed, winner, axis=0)

    alone = (kind > NO_LAYER) & lowest.equals(highest)
    unknown = graph.ReduceSum(area * alone.to("int32"), keepdims=0)
    unknown = unknown + graph.ReduceSum(votes[NO_LAYER], keepdims=0)
    return categories.to("uint8").reshape(*grid), unknown


def _cells(graph: Graph, pixels: Symbol, cells: Symbol) -> _Cells:
    first, last = ((graph.arange(cells) + step) * pixels + cells - 1 for step in (0, 1))
    first, last = first // cells, last // cells
    return _Cells(pixels, (pixels + cells - 1) // cells, first, last - first)


def _over_cells(
    graph: Graph, extreme: Callable[..., Symbol], entries: Symbol, tall: _Cells, wide: _Cells
) -> Symbol:
    """``(h * w,)`` int32, the least or the largest entry of each cell."""
    for cells in (tall, wide):
        step = graph.Min(graph.arange(cells.longest), cells.length.reshape(-1, 1) - 1)
        within = graph.Gather(entries, cells.first.reshape(-1, 1) + step, axis=0)
        entries = graph.Transpose(extreme(within, [1], keepdims=0), perm=[1, 0])
    return entries.to("int32").reshape(-1)


def _entries_of(
    graph: Graph, entries: Symbol, nothing: int, chosen: Symbol, tall: _Cells, wide: _Cells
) -> tuple[Symbol, Symbol]:
    """``(n, most)`` int32, the entries of the pixels of some cells, ``nothing`` where a cell has no
    more; and ``most``, the pixels of the largest cell."""
    count, area = graph.Size(wide.first).to("int32"), tall.pixels * wide.pixels

    def pixels(cells: _Cells, number: Symbol, stride: Symbol | int) -> Symbol:
        step = graph.arange(cells.longest)
        place = (cells.first.take(number).reshape(-1, 1) + step) * stride
        return graph.Where(step < cells.length.take(number).reshape(-1, 1), place, area)

    rows = pixels(tall, chosen // count, wide.pixels).reshape(-1, tall.longest, 1)
    columns = pixels(wide, chosen % count, 1).reshape(-1, 1, wide.longest)
    most = tall.longest * wide.longest
    place = (rows + columns).reshape(-1)
    found = entries.reshape(-1).take(graph.Min(place, area - 1)).to("int32")
    return graph.Where(place < area, found, nothing).reshape(-1, most), most


def _votes(graph: Graph, seen: Symbol, table: npt.NDArray[np.uint8], most: Symbol) -> Symbol:
    """``(9, n)`` int32, how many pixels of each cell have each layer, and an unknown id, from their
    entries in the table, ``(n, most)``; an entry after its end has no vote.

    The counts of several kinds share a number, in as many bits each as the largest cell needs.
    """
    kinds = NO_LAYER + 1
    powers = graph.constant(1 << np.arange(_EXACT_BITS + 1, dtype=np.int32))
    bits = graph.ReduceSum((powers <= most).to("int32"), keepdims=0)
    fields, field_size = _EXACT_BITS // bits, powers.take(bits.reshape(1))
    kind = np.append(np.where(table == NO_LAYER, kinds, np.minimum(table, NO_LAYER)), kinds)
    entries = seen.reshape(-1)

    def count(step: Symbol, votes: Symbol) -> list[Symbol]:
        field = graph.constant(np.arange(kinds, dtype=np.int32)) - step * fields
        kept = ((field >= 0) & (field < fields)).to("int32")
        unit = powers.take(field * bits * kept)
        number = graph.Pad(unit * kept, [0, 1]).take(graph.constant(kind.astype(np.int32)))
        of_pixels = number.to("float32").take(entries).reshape(-1, most)
        total = graph.ReduceSum(of_pixels, [1], keepdims=0).to("int32")
        counted = total.reshape(1, -1) // unit.reshape(-1, 1) % field_size
        return [votes + counted * kept.reshape(-1, 1)]

    passes = (fields + NO_LAYER) // fields
    zeros = graph.full([kinds, graph.sizes(seen, 2)[0]], 0, "int32")
    return graph.repeat(passes, count, zeros, rank=2)[0]
