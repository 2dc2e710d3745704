"""Skeleton as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...stages.skeleton import Rule
from ..graph import Graph, Symbol
from ..words import ALL, Words, neighbourhood, shifted


def thin_in_graph(graph: Graph, words: Words, rule: Rule, large: bool) -> Words:
    """The skeleton of every layer, in a graph; by frontier, as `thin`.

    The frontier begins around the words with a border pixel, one with an off pixel N, E, S or W
    of it: no rule deletes another. Later a word to the left or right of one that changed is in it
    only if the pixel beside it changed.

    Args:
        graph: where the nodes go.
        words: the layers.
        rule: `zhang_suen` or `guo_hall`.
        large: whether to look for the frontier by blocks of words: of a large image it is a small
            part, and a runtime takes long to list what is not zero.
    """
    grid, margin, block = words.grid, words.grid.pitch + 1, 16 if large else 1
    length = (grid.words + block - 1) // block * block
    centre, (north, _, east, _, south, _, west, _) = neighbourhood(graph, words)
    border = centre & ~(north & east & south & west)
    rows = graph.Concat(*(graph.vector(row) for row in (0, grid.pitch, grid.pitch * 2)), axis=0)
    around = rows.to("int32").reshape(1, -1, 1)
    around = around + graph.constant(np.arange(3, dtype=np.int32)[:, None, None])

    def near(flags: Symbol, line: Symbol) -> Symbol:
        """Numbers of the words that are not empty, flagged themselves or above or below one."""
        above, here, below = (
            flags[grid.pitch * row + 1 : grid.pitch * row + length + 1] for row in range(3)
        )
        seen, pixels = above | here | below, line[margin : length + margin]
        if not large:
            return graph.places(seen & pixels.to("bool"))
        seen, pixels = (part.reshape(-1, block) for part in (seen, pixels))
        chosen = graph.places(graph.ReduceMax(seen.to("uint8"), [1], keepdims=0))
        some = graph.Gather(seen, chosen, axis=0) & graph.Gather(pixels, chosen, axis=0).to("bool")
        row, word = graph.split(graph.NonZero(some).to("int32"), 2)
        return chosen.take(row.reshape(-1)) * block + word.reshape(-1)

    def sub_iteration(line: Symbol, *recent: Symbol, first: bool) -> tuple[Symbol, Symbol, Symbol]:
        frontier = near(recent[0] | recent[1], line)
        nine = line.take((frontier + around).reshape(-1)).reshape(3, 3, -1)
        before, here, after = graph.split(nine, 3, axis=0)
        west, east = shifted(before, here, after)
        (n, centre, s), (nw, w, sw), (ne, e, se) = (
            graph.split(part, 3, axis=1) for part in (here, west, east)
        )
        left = rule(centre, (n, ne, e, se, s, sw, w, nw), first)
        place, gone = frontier + margin, (centre - left).reshape(-1)
        line = graph.ScatterElements(line, place, left.reshape(-1), axis=0)
        return line, _flags(graph, place, gone, graph.length(line)), gone

    def iteration(_: Symbol, line: Symbol, *recent: Symbol) -> Sequence[Symbol]:
        line, one, gone = sub_iteration(line, *recent, first=True)
        line, other, also_gone = sub_iteration(line, recent[1], one, first=False)
        return graph.any(graph.Concat(gone, also_gone, axis=0)), line, one, other

    padding = graph.vector(margin, margin + length - grid.words)
    line, start = (graph.Pad(part, padding) for part in (centre, border))
    start = start.to("bool")
    line, *_ = graph.repeat_while(iteration, line, start, start)
    return words.with_line(line[margin : grid.words + margin])


def _flags(graph: Graph, place: Symbol, gone: Symbol, length: Symbol) -> Symbol:
    """``(length,)`` bool, at the places of words of which pixels are gone, and at those to the
    right and left whose neighbours are gone."""
    places = graph.Concat(place, place + 1, place - 1, axis=0)
    changed = graph.Concat(gone > 0, gone > ALL >> 8, (gone & 255) > 0, axis=0)
    return graph.sums(places, changed.to("uint8"), length).to("bool")
