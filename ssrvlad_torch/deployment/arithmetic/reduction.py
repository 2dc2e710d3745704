"""Reduction as arithmetic: a pixel's vote is a number with a digit for each kind.

The votes of up to nine pixels above each other are added, so that no digit carries. Then the digits
are taken apart and added over the columns and the groups of rows of a cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...stages.layers import UNKNOWN
from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol

RADIX = 10
_LOW = 4
"""Digits of the lower part of a number."""
_PART = 1 << 14
"""Where the upper part begins, above 9999. Nine votes are at most ``9 * 10 ** 2 * _PART``, which is
below 2 ** 24."""
_DIGITS = 7

WIDEST_CELL = 800
"""Columns of a cell: sums of ``2 * 10 ** 4`` over them stay below 2 ** 24."""

KINDS = NO_LAYER + 2
"""Eight layers, none or an unknown id, and an unknown id."""

Table = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]


class Side(NamedTuple):
    """A side of the image in cells, whose pixels are in groups of one length.

    Attributes:
        cells, groups, length: ``()`` int32, how many cells, groups in each, and pixels in those.
        place: ``(groups * cells * length,)`` int32, the first group of every cell, then the second,
            ...; a place without a pixel holds the number of pixels.
        pixels: ``(groups * cells,)`` float32, how many pixels each group has.
    """

    cells: Symbol
    groups: Symbol
    length: Symbol
    place: Symbol
    pixels: Symbol


def side_of(graph: Graph, pixels: Symbol, cells: Symbol, most: int = 0) -> Side:
    """A side in groups of at most so many pixels; pixel x is in cell ``x * cells // pixels``."""
    first, end = ((graph.arange(cells) + step) * pixels + cells - 1 for step in (0, 1))
    first, end = ((number // cells).reshape(-1, 1) for number in (first, end))
    longest = (pixels + cells - 1) // cells
    groups = (longest + most - 1) // most if most else graph.constant(np.array(1, np.int32))
    length = (longest + groups - 1) // groups
    place = first + graph.arange(groups * length).reshape(groups, 1, length)
    within = place < end
    count = graph.ReduceSum(within.to("float32"), [2], keepdims=0)
    place = graph.Where(within, place, pixels)
    return Side(cells, groups, length, place.reshape(-1), count.reshape(-1))


def votes_in_graph(
    graph: Graph, entries: Symbol, table: Table, rows: Side, columns: Side
) -> Symbol:
    """How many pixels of each cell are of each kind.

    Args:
        graph: where the nodes go.
        entries: ``(B, H, W)`` uint8 or int32, for each pixel its entry in the table.
        table: ``(T,)`` uint8, 0 to 7, `NO_LAYER` or `UNKNOWN`.
        rows: h cells, in groups of at most nine pixels.
        columns: w cells, in one group.

    Returns:
        ``(B, 10, h * w)`` float32.
    """
    entries, table = _with_margin(graph, entries, table)
    width = graph.sizes(entries, 3)[2]
    entry = graph.Gather(entries, rows.place, axis=1).to("int32").reshape(-1)
    kinds = sorted({*table.tolist(), UNKNOWN} - {NO_LAYER})
    sums: list[Symbol] = []
    to_kinds: list[Floats] = []
    words = -(-len(kinds) // _DIGITS)
    for chosen in (kinds[number::words] for number in range(words)):
        word = graph.constant(_word_table(table, chosen)).take(entry)
        by_column = graph.ReduceSum(word.reshape(-1, rows.length, width), [1], keepdims=0)
        by_column = by_column.reshape(-1, rows.groups * rows.cells, width)
        by_column = graph.Transpose(by_column, perm=[0, 2, 1])
        sums += [
            _over(graph, part, columns) for part in _taken_apart(graph, by_column, len(chosen))
        ]
        to_kinds += _to_kinds(chosen)
    summed = graph.Concat(*sums, axis=1)
    summed = summed.reshape(-1, columns.cells, len(to_kinds), rows.groups * rows.cells)
    summed = graph.Transpose(summed, perm=[0, 2, 3, 1]).reshape(0, len(to_kinds), -1)
    areas = (rows.pixels.reshape(-1, 1) * columns.pixels).reshape(1, 1, -1)
    areas = graph.Expand(areas, graph.vector(graph.sizes(entries, 3)[0], 1, 1))
    to_kinds.append(np.eye(KINDS, dtype=np.float32)[NO_LAYER])
    table_of_kinds = graph.constant(np.stack(to_kinds, axis=1))
    votes = graph.MatMul(table_of_kinds, graph.Concat(summed, areas, axis=1))
    votes = votes.reshape(-1, KINDS, rows.groups, rows.cells * columns.cells)
    return graph.ReduceSum(votes, [2], keepdims=0)


def _with_margin(graph: Graph, entries: Symbol, table: Table) -> tuple[Symbol, Table]:
    """One more row and column of pixels without a vote."""
    empty = np.flatnonzero(table == NO_LAYER)
    if empty.size == 0:
        entries, empty = entries.to("int32"), np.array([len(table)])
        table = np.append(table, np.uint8(NO_LAYER))
    nothing = graph.constant(empty[0].astype(entries.dtype))
    return graph.Pad(entries, [0, 0, 0, 0, 1, 1], nothing), table


def _word_table(table: Table, kinds: Sequence[int]) -> Floats:
    """The vote of each entry."""
    words = np.zeros(len(table), np.float32)
    for digit, kind in enumerate(kinds):
        words[table == kind] = _PART ** (digit // _LOW) * RADIX ** (digit % _LOW)
    return words


def _taken_apart(graph: Graph, word: Symbol, digits: int) -> Iterator[Symbol]:
    """``(B, W, n)`` -> the lower part without none, one, ... of its last digits, then the upper
    part, in ``(B, W, some, n)``. The digits together are as many as are asked for."""
    parts = [(word, digits)]
    if digits > _LOW:
        upper = graph.Floor(word * (1 / _PART))
        parts = [(word - upper * _PART, _LOW), (upper, digits - _LOW)]
    for part, count in parts:
        whole = graph.Unsqueeze(part, [2])
        yield whole
        if count > 1:
            scales = float(RADIX) ** -np.arange(1, count, dtype=np.float32)[:, None]
            yield graph.Floor((whole + 0.5) * graph.constant(scales))


def _over(graph: Graph, numbers: Symbol, columns: Side) -> Symbol:
    """``(B, W, some, n)`` -> ``(B * w, some, n)``, the sums over the columns of each cell."""
    _, _, some, n = graph.sizes(numbers, 4)
    of_cells = graph.Gather(numbers, columns.place, axis=1).reshape(-1, columns.length, some, n)
    return graph.ReduceSum(of_cells, [1], keepdims=0)


def _to_kinds(kinds: Sequence[int]) -> Iterator[Floats]:
    """For each number of `_taken_apart` what it adds to the votes of all kinds. A digit is the
    number that ends with it, less ten times the one without it; a vote is one less for none."""
    for digit, kind in enumerate(kinds):
        row = np.zeros(KINDS, np.float32)
        row[_row(kind)] = 1
        if digit % _LOW:
            row[_row(kinds[digit - 1])] = -RADIX
        row[NO_LAYER] = -row[:NO_LAYER].sum()
        yield row


def _row(kind: int) -> int:
    return KINDS - 1 if kind == UNKNOWN else kind
