"""Skeleton as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...stages.skeleton import Rule
from ..graph import Graph, Symbol
from ..words import ALL, Words, neighbourhood, shifted


def thin_in_graph(graph: Graph, words: Words, rule: Rule, large: bool) -> Words:
    """`thin` in a graph: the skeleton of every layer, by its frontier.

    The first frontier are the words with a border pixel, which has background N, E, S or W of it,
    and their neighbours: no rule deletes another pixel. Later a word to the left or right of a
    changed word belongs to the frontier only if the adjacent pixel changed.

    Args:
        graph: the graph to add nodes to.
        words: the layers.
        rule: `zhang_suen` or `guo_hall`.
        large: whether to search the frontier by blocks of words: it is a small part of a large
            image, and runtimes are slow in `NonZero`.
    """
    grid, margin, block = words.grid, words.grid.pitch + 1, 16 if large else 1
    length = (grid.words + block - 1) // block * block
    centre, (north, _, east, _, south, _, west, _) = neighbourhood(graph, words)
    border = centre & ~(north & east & south & west)
    rows = graph.Concat(*(graph.vector(row) for row in (0, grid.pitch, grid.pitch * 2)), axis=0)
    around = rows.to("int32").reshape(1, -1, 1)
    around = around + graph.constant(np.arange(3, dtype=np.int32)[:, None, None])

    def near(flags: Symbol, line: Symbol) -> Symbol:
        """Numbers of the words with pixels that have a flag at, above or below them."""
        above, here, below = (
            flags[grid.pitch * row + 1 : grid.pitch * row + length + 1] for row in range(3)
        )
        flagged, pixels = above | here | below, line[margin : length + margin]
        if not large:
            return graph.indices(flagged & pixels.to("bool"))
        flagged, pixels = (part.reshape(-1, block) for part in (flagged, pixels))
        blocks = graph.indices(graph.ReduceMax(flagged.to("uint8"), [1], keepdims=0))
        flagged, pixels = (graph.Gather(part, blocks, axis=0) for part in (flagged, pixels))
        row, word = graph.split(graph.NonZero(flagged & pixels.to("bool")).to("int32"), 2)
        return blocks.take(row.reshape(-1)) * block + word.reshape(-1)

    def sub_iteration(line: Symbol, *recent: Symbol, first: bool) -> tuple[Symbol, Symbol, Symbol]:
        frontier = near(recent[0] | recent[1], line)
        nine = line.take((frontier + around).reshape(-1)).reshape(3, 3, -1)
        before, here, after = graph.split(nine, 3, axis=0)
        west, east = shifted(before, here, after)
        (n, centre, s), (nw, w, sw), (ne, e, se) = (
            graph.split(part, 3, axis=1) for part in (here, west, east)
        )
        thinned = rule(centre, (n, ne, e, se, s, sw, w, nw), first)
        index, deleted = frontier + margin, (centre - thinned).reshape(-1)
        line = graph.ScatterElements(line, index, thinned.reshape(-1), axis=0)
        return line, _flags(graph, index, deleted, graph.length(line)), deleted

    def iteration(_: Symbol, line: Symbol, *recent: Symbol) -> Sequence[Symbol]:
        line, flags, deleted = sub_iteration(line, *recent, first=True)
        line, last_flags, last_deleted = sub_iteration(line, recent[1], flags, first=False)
        going = graph.any(graph.Concat(deleted, last_deleted, axis=0))
        return going, line, flags, last_flags

    padding = graph.vector(margin, margin + length - grid.words)
    line, start = (graph.Pad(part, padding) for part in (centre, border))
    start = start.to("bool")
    line, *_ = graph.repeat_while(iteration, line, start, start)
    return words.with_line(line[margin : grid.words + margin])


def _flags(graph: Graph, index: Symbol, deleted: Symbol, length: Symbol) -> Symbol:
    """``(length,)`` bool, set for words with deleted pixels, and for words to the right and left of
    them whose adjacent pixel was deleted."""
    indices = graph.Concat(index, index + 1, index - 1, axis=0)
    changed = graph.Concat(deleted > 0, deleted > ALL >> 8, (deleted & 255) > 0, axis=0)
    return graph.sums(indices, changed.to("uint8"), length).to("bool")
