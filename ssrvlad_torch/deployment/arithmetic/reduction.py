"""Reduction as arithmetic: a pixel's vote is a number with a decimal digit for each kind.

The votes of up to nine pixels of a column are added, so that no digit carries. Then the digits are
separated and added over the columns and the groups of rows of a cell.
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
"""Digits of the lower part of a vote."""
_PART = 1 << 14
"""Unit of the upper part, above 9999. Nine votes are at most ``9 * 10 ** 2 * _PART`` < 2 ** 24."""
_DIGITS = 7

MAX_CELL_WIDTH = 800
"""Columns of a cell: sums of ``2 * 10 ** 4`` over them are below 2 ** 24."""

KINDS = NO_LAYER + 2
"""Votes of a cell: for eight layers, for no layer (with unknown ids), and for unknown ids."""

Table = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]


class Side(NamedTuple):
    """A side of the image in cells, with the pixels of a cell in groups of one length.

    Attributes:
        cells, groups, length: ``()`` int32, numbers of cells, of groups in a cell and of entries in
            a group.
        members: ``(groups * cells * length,)`` int32, the pixels of the first group of every cell,
            then of the second, ...; an entry without a pixel is the number of pixels.
        pixels: ``(groups * cells,)`` float32, the number of pixels of each group.
    """

    cells: Symbol
    groups: Symbol
    length: Symbol
    members: Symbol
    pixels: Symbol


def side_of(graph: Graph, pixels: Symbol, cells: Symbol, most: int = 0) -> Side:
    """A side in groups of at most ``most`` pixels; pixel x is in cell ``x * cells // pixels``."""
    first, end = ((graph.arange(cells) + step) * pixels + cells - 1 for step in (0, 1))
    first, end = ((number // cells).reshape(-1, 1) for number in (first, end))
    longest = (pixels + cells - 1) // cells
    groups = (longest + most - 1) // most if most else graph.constant(np.array(1, np.int32))
    length = (longest + groups - 1) // groups
    index = first + graph.arange(groups * length).reshape(groups, 1, length)
    is_pixel = index < end
    count = graph.ReduceSum(is_pixel.to("float32"), [2], keepdims=0)
    index = graph.Where(is_pixel, index, pixels)
    return Side(cells, groups, length, index.reshape(-1), count.reshape(-1))


def votes_in_graph(
    graph: Graph, entries: Symbol, table: Table, rows: Side, columns: Side
) -> Symbol:
    """The number of pixels of each kind in each cell.

    Args:
        graph: the graph to add nodes to.
        entries: ``(B, H, W)`` uint8 or int32, the index of each pixel in the table.
        table: ``(T,)`` uint8: 0 to 7, `NO_LAYER` or `UNKNOWN`.
        rows: the h cells, in groups of at most nine pixels.
        columns: the w cells, in one group.

    Returns:
        ``(B, 10, h * w)`` float32.
    """
    entries, table = _with_margin(graph, entries, table)
    width = graph.sizes(entries, 3)[2]
    entry = graph.Gather(entries, rows.members, axis=1).to("int32").reshape(-1)
    kinds = sorted({*table.tolist(), UNKNOWN} - {NO_LAYER})
    sums: list[Symbol] = []
    to_votes: list[Floats] = []
    words = -(-len(kinds) // _DIGITS)
    for chosen in (kinds[number::words] for number in range(words)):
        word = graph.constant(_word_table(table, chosen)).take(entry)
        by_column = graph.ReduceSum(word.reshape(-1, rows.length, width), [1], keepdims=0)
        by_column = by_column.reshape(-1, rows.groups * rows.cells, width)
        by_column = graph.Transpose(by_column, perm=[0, 2, 1])
        digits = _digits(graph, by_column, len(chosen))
        sums += [_summed(graph, part, columns) for part in digits]
        to_votes += _to_votes(chosen)
    summed = graph.Concat(*sums, axis=1)
    summed = summed.reshape(-1, columns.cells, len(to_votes), rows.groups * rows.cells)
    summed = graph.Transpose(summed, perm=[0, 2, 3, 1]).reshape(0, len(to_votes), -1)
    areas = (rows.pixels.reshape(-1, 1) * columns.pixels).reshape(1, 1, -1)
    areas = graph.Expand(areas, graph.vector(graph.sizes(entries, 3)[0], 1, 1))
    to_votes.append(np.eye(KINDS, dtype=np.float32)[NO_LAYER])
    vote_table = graph.constant(np.stack(to_votes, axis=1))
    votes = graph.MatMul(vote_table, graph.Concat(summed, areas, axis=1))
    votes = votes.reshape(-1, KINDS, rows.groups, rows.cells * columns.cells)
    return graph.ReduceSum(votes, [2], keepdims=0)


def _with_margin(graph: Graph, entries: Symbol, table: Table) -> tuple[Symbol, Table]:
    """The entries with one more row and column of pixels without a vote, and their table."""
    no_layer = np.flatnonzero(table == NO_LAYER)
    if no_layer.size == 0:
        entries, no_layer = entries.to("int32"), np.array([len(table)])
        table = np.append(table, np.uint8(NO_LAYER))
    fill = graph.constant(no_layer[0].astype(entries.dtype))
    return graph.Pad(entries, [0, 0, 0, 0, 1, 1], fill), table


def _word_table(table: Table, kinds: Sequence[int]) -> Floats:
    """The vote of each entry."""
    words = np.zeros(len(table), np.float32)
    for digit, kind in enumerate(kinds):
        words[table == kind] = _PART ** (digit // _LOW) * RADIX ** (digit % _LOW)
    return words


def _digits(graph: Graph, word: Symbol, digits: int) -> Iterator[Symbol]:
    """``(B, W, n)`` votes -> ``(B, W, m, n)``: the lower part without its last 0, 1, ... digits,
    then the same of the upper part; together ``digits`` numbers."""
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


def _summed(graph: Graph, numbers: Symbol, columns: Side) -> Symbol:
    """``(B, W, m, n)`` -> ``(B * w, m, n)``, the sums over the columns of each cell."""
    _, _, m, n = graph.sizes(numbers, 4)
    by_cell = graph.Gather(numbers, columns.members, axis=1).reshape(-1, columns.length, m, n)
    return graph.ReduceSum(by_cell, [1], keepdims=0)


def _to_votes(kinds: Sequence[int]) -> Iterator[Floats]:
    """For each number of `_digits` its factors in the votes of all kinds. A digit is the number
    that ends with it minus ten times the next; each vote for a kind is one less for no layer."""
    for digit, kind in enumerate(kinds):
        row = np.zeros(KINDS, np.float32)
        row[_row(kind)] = 1
        if digit % _LOW:
            row[_row(kinds[digit - 1])] = -RADIX
        row[NO_LAYER] = -row[:NO_LAYER].sum()
        yield row


def _row(kind: int) -> int:
    return KINDS - 1 if kind == UNKNOWN else kind
