"""Skeleton as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...stages.skeleton import Rule
from ..graph import Graph, Symbol
from ..words import Grid, Words, neighbourhood, shifted

_ALL_BUT_TOP_BYTE = (1 << 56) - 1


def thin_in_graph(graph: Graph, words: Words, rule: Rule) -> Words:
    """The skeleton of every layer, in a graph; by frontier, as `thin`.

    The frontier begins around the words with a border pixel, one with an off pixel N, E, S or W
    of it: no rule deletes another. Later a word to the left or right of one that changed is in it
    only if the pixel beside it changed. `_near` has what carries this from step to step.
    """
    grid, margin = words.grid, words.grid.pitch + 1
    centre, (north, _, east, _, south, _, west, _) = neighbourhood(graph, words)
    border = centre & ~(north & east & south & west)
    rows = graph.Concat(*(graph.vector(row) for row in (0, grid.pitch, grid.pitch * 2)), axis=0)
    around = rows.reshape(1, -1, 1) + graph.constant(np.arange(3)[:, None, None])

    def sub_iteration(line: Symbol, *recent: Symbol, first: bool) -> tuple[Symbol, Symbol, Symbol]:
        frontier = graph.NonZero(_near(recent[0] | recent[1], grid).to("uint8")).reshape(-1)
        nine = line.take((frontier + around).reshape(-1)).reshape(3, 3, -1)
        before, here, after = graph.split(nine, 3, axis=0)
        west, east = shifted(before, here, after)
        (n, centre, s), (nw, w, sw), (ne, e, se) = (
            graph.split(part, 3, axis=1) for part in (here, west, east)
        )
        left = rule(centre, (n, ne, e, se, s, sw, w, nw), first)
        place, gone = frontier + margin, (centre ^ left).reshape(-1)
        line = graph.ScatterElements(line, place, left.reshape(-1), axis=0)
        return line, _flags(graph, place, gone, graph.Size(line)), gone

    def iteration(_: Symbol, line: Symbol, *recent: Symbol) -> Sequence[Symbol]:
        line, one, gone = sub_iteration(line, *recent, first=True)
        line, other, also_gone = sub_iteration(line, recent[1], one, first=False)
        return graph.any(graph.Concat(gone, also_gone, axis=0).to("bool")), line, one, other

    line, start = (graph.Pad(part, graph.vector(margin, margin)) for part in (centre, border))
    start = start.to("bool")
    line, *_ = graph.repeat_while(iteration, line, start, start)
    return words.with_line(line[margin : grid.words + margin])


def _flags(graph: Graph, place: Symbol, gone: Symbol, length: Symbol) -> Symbol:
    """``(length,)`` bool, at the places of words of which pixels are gone, and at those to the
    right and left whose neighbours are gone."""
    places = graph.Concat(place, place + 1, place - 1, axis=0)
    pixels = graph.Concat(gone, gone & ~_ALL_BUT_TOP_BYTE, gone & 255, axis=0)
    return graph.sums(places, pixels.to("bool").to("uint8"), length).to("bool")


def _near(flags: Symbol, grid: Grid) -> Symbol:
    """``(grid.words,)`` bool from flags on the line with margins: one at, above or below."""
    above, here = flags[1 : grid.words + 1], flags[grid.pitch + 1 : grid.words + grid.pitch + 1]
    return above | here | flags[grid.pitch * 2 + 1 : -1]
