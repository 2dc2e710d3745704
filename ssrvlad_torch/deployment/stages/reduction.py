"""Reduction as ONNX operators."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol

_EXACT_BITS = 24
"""Whole numbers of this many bits are exact in float32."""


class _Side(NamedTuple):
    """A side of the image in cells.

    Attributes:
        pixels, cells: ``()`` int32, the numbers of pixels and cells.
        longest: ``()`` int32, pixels of a longest cell; the others have one pixel less.
        first, length: ``(cells,)`` int32, the first pixel and the number of pixels of each cell.
        step: ``(2, longest)`` int32, offsets of the pixels of a shorter and of a longest cell from
            its first; in the shorter the last offset is repeated.
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
    def is_repeated(self) -> Symbol:
        """``(2, longest)`` bool, whether an entry of `step` repeats the one before it."""
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
    """`reduce_by_majority` in a graph, together with the look-up of categories.

    Most cells hold one id: their smallest and largest ids are equal. Votes are counted in the other
    cells only.

    Args:
        graph: the graph to add nodes to.
        entries: ``(B, H, W)`` uint8 or int32, the index of each pixel in the table.
        table: ``(T,)`` uint8: 0 to 7, `NO_LAYER`, or larger for an unknown id, which votes for no
            layer.
        size: H and W, ``()`` int32.
        grid: h and w, ``()`` int32.

    Returns:
        ``(B, h, w)`` uint8, and ``(B,)`` int32, the number of unknown ids.
    """
    tall, wide = (_side(graph, *lengths) for lengths in zip(size, grid, strict=True))
    lowest, highest = _extremes(graph, entries, tall, wide)  # (B, w, h)
    kind = graph.constant(table.astype(np.int32)).take(lowest.to("int32").reshape(-1))
    is_pure = lowest.equals(highest).reshape(-1)
    area = tall.length * wide.length.reshape(-1, 1)

    mixed = graph.indices(~is_pure)
    row, column = mixed % tall.cells, mixed // tall.cells % wide.cells
    image = mixed // (tall.cells * wide.cells)
    pixels = _pixels(graph, entries, len(table), tall, wide, (image, row, column))
    votes = _votes(graph, pixels, table, tall.longest * wide.longest)
    no_layer = area.reshape(-1).take(mixed % (tall.cells * wide.cells)).reshape(1, -1)
    no_layer = no_layer - graph.ReduceSum(votes[:NO_LAYER], [0])
    all_votes = graph.Concat(votes[:NO_LAYER], no_layer, axis=0)
    winner = graph.ArgMax(all_votes, axis=0, keepdims=0).to("int32")
    categories = graph.ScatterElements(graph.Min(kind, NO_LAYER), mixed, winner, axis=0)

    all_unknown = ((kind > NO_LAYER) & is_pure).to("int32").reshape(-1, wide.cells, tall.cells)
    unknown = graph.ReduceSum(area * all_unknown, [1, 2], keepdims=0)
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
    """``(B, w, h)`` float32, the smallest and the largest entry of each cell."""
    rows = graph.Gather(entries, tall.pixel, axis=1).to("float32")

    def over_cells(extreme: Callable[..., Symbol]) -> Symbol:
        by_row = graph.Transpose(extreme(rows, [2], keepdims=0), perm=[0, 2, 1])
        return extreme(graph.Gather(by_row, wide.pixel, axis=1), [2], keepdims=0)

    return over_cells(graph.ReduceMin), over_cells(graph.ReduceMax)


def _pixels(
    graph: Graph,
    entries: Symbol,
    filler: int,
    tall: _Side,
    wide: _Side,
    cells: tuple[Symbol, Symbol, Symbol],
) -> Symbol:
    """``(n, most)`` int32, the entries of the pixels of n cells. Repeated pixels have the entry
    ``filler``, which is above all others. ``cells``: image, row and column, ``(n,)`` int32 each."""
    image, row, column = cells
    kind = tall.is_longest.take(row) * 2 + wide.is_longest.take(column)
    step = tall.step.reshape(2, 1, -1, 1) * wide.pixels + wide.step.reshape(1, 2, 1, -1)
    repeated = tall.is_repeated.reshape(2, 1, -1, 1) | wide.is_repeated.reshape(1, 2, 1, -1)
    first = (image * tall.pixels + tall.first.take(row)) * wide.pixels + wide.first.take(column)
    index = first.reshape(-1, 1) + step.reshape(4, -1)[kind]
    flat = entries.reshape(-1).take(index.reshape(-1)).to("int32")
    pixels = graph.Reshape(flat, graph.Shape(index))
    return graph.Max(pixels, (repeated.to("int32") * filler).reshape(4, -1)[kind])


def _votes(graph: Graph, pixels: Symbol, table: npt.NDArray[np.uint8], most: Symbol) -> Symbol:
    """``(9, n)`` int32, the number of pixels of each cell in each layer, and of unknown ids. Pixels
    are ``(n, most)`` entries; an entry after the end of the table has no vote.

    The counts of several kinds share a number; each has as many bits as the largest cell needs.
    """
    kinds = NO_LAYER + 1
    powers = graph.constant(1 << np.arange(_EXACT_BITS + 1, dtype=np.int32))
    bits = graph.ReduceSum((powers <= most).to("int32"), keepdims=0)
    fields = _EXACT_BITS // bits
    kind = graph.constant(np.arange(kinds, dtype=np.int32))
    word, unit = kind // fields, powers.take(kind % fields * bits)
    passes = (fields + NO_LAYER) // fields
    words = graph.arange(passes).reshape(-1, 1)
    by_kind = graph.Pad(graph.Where(word.equals(words), unit, 0), [0, 0, 0, 1])
    column = np.append(np.where(table == NO_LAYER, kinds, np.minimum(table, NO_LAYER)), kinds)
    by_entry = graph.Gather(by_kind, graph.constant(column.astype(np.int32)), axis=1)
    index = pixels.reshape(1, -1) + words * len(column)
    numbers = by_entry.to("float32").reshape(-1).take(index.reshape(-1))
    total = graph.ReduceSum(numbers.reshape(passes, -1, most), [2], keepdims=0)
    return total.to("int32")[word] // unit.reshape(-1, 1) % powers.take(bits.reshape(1))
