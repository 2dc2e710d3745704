"""Reduction as ONNX operators."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol

_EXACT_BITS = 24
"""Whole numbers of so many bits are exact in float32."""


class _Side(NamedTuple):
    """A side of the image in cells.

    Attributes:
        pixels, cells: ``()`` int32, how many.
        longest: ``()`` int32, pixels of the longest cell; no cell has two less.
        first, length: ``(cells,)`` int32, the first pixel of each cell and how many it has.
        step: ``(2, longest)`` int32, how far the pixels of a shorter and of a longest cell are from
            its first; the last stands twice in the shorter.
    """

    pixels: Symbol
    cells: Symbol
    longest: Symbol
    first: Symbol
    length: Symbol
    step: Symbol

    @property
    def is_longest(self) -> Symbol:
        """``(cells,)`` int32, 1 or 0."""
        return self.length - self.longest + 1

    @property
    def pixel(self) -> Symbol:
        """``(cells, longest)`` int32, the pixels of each cell."""
        return self.first.reshape(-1, 1) + self.step[self.is_longest]

    @property
    def stands_twice(self) -> Symbol:
        """``(2, longest)`` bool, of `step`."""
        graph = self.step.graph
        lengths = self.longest - graph.constant(np.array([[1], [0]], np.int32))
        return graph.arange(self.longest) >= lengths


def reduce_by_majority_in_graph(
    graph: Graph,
    entries: Symbol,
    table: npt.NDArray[np.uint8],
    size: tuple[Symbol, Symbol],
    grid: tuple[Symbol, Symbol],
) -> tuple[Symbol, Symbol]:
    """`reduce_by_majority` in a graph, of images whose ids are not looked up yet.

    Most cells hold one id: the least and the largest of their ids are the same. Votes are counted
    in the others only.

    Args:
        graph: where the nodes go.
        entries: ``(B, H, W)`` uint8 or int32, for each pixel its entry in the table.
        table: ``(T,)`` uint8, 0 to 7, `NO_LAYER`, or above it for an unknown id, which votes as if
            it had no layer.
        size: H and W, ``()`` int32.
        grid: h and w, likewise.

    Returns:
        ``(B, h, w)`` uint8, and ``(B,)`` int32, the number of unknown ids.
    """
    tall, wide = (_side(graph, *lengths) for lengths in zip(size, grid, strict=True))
    lowest, highest = _extremes(graph, entries, tall, wide)  # (B, w, h)
    kind = graph.constant(table.astype(np.int32)).take(lowest.to("int32").reshape(-1))
    is_pure = lowest.equals(highest).reshape(-1)
    area = tall.length * wide.length.reshape(-1, 1)

    mixed = graph.places(~is_pure)
    row, column = mixed % tall.cells, mixed // tall.cells % wide.cells
    image = mixed // (tall.cells * wide.cells)
    seen = _pixels(graph, entries, len(table), tall, wide, (image, row, column))
    votes = _votes(graph, seen, table, tall.longest * wide.longest)
    rest = area.reshape(-1).take(mixed % (tall.cells * wide.cells)).reshape(1, -1)
    rest = rest - graph.ReduceSum(votes[:NO_LAYER], [0])
    ballot = graph.Concat(votes[:NO_LAYER], rest, axis=0)
    winner = graph.ArgMax(ballot, axis=0, keepdims=0).to("int32")
    categories = graph.ScatterElements(graph.Min(kind, NO_LAYER), mixed, winner, axis=0)

    alone = ((kind > NO_LAYER) & is_pure).to("int32").reshape(-1, wide.cells, tall.cells)
    unknown = graph.ReduceSum(area * alone, [1, 2], keepdims=0)
    unknown = graph.ScatterElements(
        unknown, image, votes[NO_LAYER].reshape(-1), axis=0, reduction="add"
    )
    categories = categories.reshape(-1, wide.cells, tall.cells).to("uint8")
    return graph.Transpose(categories, perm=[0, 2, 1]), unknown


def _side(graph: Graph, pixels: Symbol, cells: Symbol) -> _Side:
    first, last = ((graph.arange(cells) + step) * pixels + cells - 1 for step in (0, 1))
    first, last = first // cells, last // cells
    longest = (pixels + cells - 1) // cells
    ends = longest - graph.constant(np.array([[2], [1]], np.int32))
    step = graph.Max(graph.Min(graph.arange(longest), ends), 0)
    return _Side(pixels, cells, longest, first, last - first, step)


def _extremes(graph: Graph, entries: Symbol, tall: _Side, wide: _Side) -> tuple[Symbol, Symbol]:
    """``(B, w, h)`` float32, the least and the largest entry of each cell."""
    rows = graph.Gather(entries, tall.pixel, axis=1).to("float32")
    found = []
    for extreme in (graph.ReduceMin, graph.ReduceMax):
        of_rows = graph.Transpose(extreme(rows, [2], keepdims=0), perm=[0, 2, 1])
        found.append(extreme(graph.Gather(of_rows, wide.pixel, axis=1), [2], keepdims=0))
    return found[0], found[1]


def _pixels(
    graph: Graph,
    entries: Symbol,
    nothing: int,
    tall: _Side,
    wide: _Side,
    cells: tuple[Symbol, Symbol, Symbol],
) -> Symbol:
    """``(n, most)`` int32, the entries of the pixels of some cells, and ``nothing``, which is above
    all of them, for what stands twice. The cells are image, row and column, ``(n,)`` int32 each."""
    image, row, column = cells
    kind = tall.is_longest.take(row) * 2 + wide.is_longest.take(column)
    step = tall.step.reshape(2, 1, -1, 1) * wide.pixels + wide.step.reshape(1, 2, 1, -1)
    twice = tall.stands_twice.reshape(2, 1, -1, 1) | wide.stands_twice.reshape(1, 2, 1, -1)
    first = (image * tall.pixels + tall.first.take(row)) * wide.pixels + wide.first.take(column)
    place = first.reshape(-1, 1) + step.reshape(4, -1)[kind]
    seen = graph.Reshape(
        entries.reshape(-1).take(place.reshape(-1)).to("int32"), graph.Shape(place)
    )
    return graph.Max(seen, (twice.to("int32") * nothing).reshape(4, -1)[kind])


def _votes(graph: Graph, seen: Symbol, table: npt.NDArray[np.uint8], most: Symbol) -> Symbol:
    """``(9, n)`` int32, how many pixels of each cell have each layer, and an unknown id, from their
    entries in the table, ``(n, most)``; an entry after its end has no vote.

    The counts of several kinds share a number, in as many bits each as the largest cell needs.
    """
    kinds = NO_LAYER + 1
    powers = graph.constant(1 << np.arange(_EXACT_BITS + 1, dtype=np.int32))
    bits = graph.ReduceSum((powers <= most).to("int32"), keepdims=0)
    fields = _EXACT_BITS // bits
    kind = graph.constant(np.arange(kinds, dtype=np.int32))
    word, unit = kind // fields, powers.take(kind % fields * bits)
    passes = (fields + NO_LAYER) // fields
    words = graph.arange(passes).reshape(-1, 1)
    of_kinds = graph.Pad(graph.Where(word.equals(words), unit, 0), [0, 0, 0, 1])
    column = np.append(np.where(table == NO_LAYER, kinds, np.minimum(table, NO_LAYER)), kinds)
    of_entries = graph.Gather(of_kinds, graph.constant(column.astype(np.int32)), axis=1)
    place = seen.reshape(1, -1) + words * len(column)
    numbers = of_entries.to("float32").reshape(-1).take(place.reshape(-1))
    total = graph.ReduceSum(numbers.reshape(passes, -1, most), [2], keepdims=0)
    return total.to("int32")[word] // unit.reshape(-1, 1) % powers.take(bits.reshape(1))
