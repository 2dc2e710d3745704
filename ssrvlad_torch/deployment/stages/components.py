"""Components as ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...stages.bitplanes import LAYERS
from ..graph import Graph, Symbol
from ..words import (
    ALL,
    EACH_PIXEL,
    PIXELS,
    Words,
    first_of_runs,
    inside,
    neighbourhood,
    paint_in_graph,
    pixels_of,
    runs_of,
    up,
)


def fill_holes_in_graph(graph: Graph, words: Words, area: Symbol) -> Words:
    """`fill_holes` in a graph."""
    grid = words.grid
    background = words.with_line(inside(graph, grid) - words.line)
    gaps = runs_of(graph, background.line)
    row, first, last = grid.row(gaps.first), grid.column(gaps.first), grid.column(gaps.last)
    border = (
        row.equals(0) | row.equals(grid.height - 1) | first.equals(0) | last.equals(grid.width - 1)
    )
    small, open_ends = _over_regions(graph, background, (gaps.length, border.to("int32")), False)
    holes = (small < area) & open_ends.equals(0)
    return words.with_line(words.line + paint_in_graph(graph, gaps.where(holes), grid))


def drop_regions_in_graph(graph: Graph, words: Words, area: Symbol) -> Words:
    """`drop_regions` in a graph."""
    segments = runs_of(graph, words.line)
    (sizes,) = _over_regions(graph, words, (segments.length,), True)
    return words.with_line(
        words.line - paint_in_graph(graph, segments.where(sizes < area), words.grid)
    )


def _over_regions(
    graph: Graph, words: Words, amounts: Sequence[Symbol], diagonal: bool
) -> list[Symbol]:
    """For each run, the sums of amounts over all runs of its region."""
    upper, lower = _touching_in_graph(graph, words, diagonal)

    def propagate(_: Symbol, region: Symbol) -> tuple[Symbol, Symbol]:
        above, below = region.take(upper), region.take(lower)
        lowest = graph.Min(above, below)
        ends, lowest = graph.Concat(above, below, axis=0), graph.Concat(lowest, lowest, axis=0)
        hooked = graph.ScatterElements(region, ends, lowest, axis=0, reduction="min")
        jumped = hooked.take(hooked)
        return graph.any(~jumped.equals(region)), jumped

    count = graph.length(amounts[0])
    (region,) = graph.repeat_while(propagate, graph.arange(count))
    return [graph.sums(region, each, count).take(region) for each in amounts]


def _touching_in_graph(graph: Graph, words: Words, diagonal: bool) -> tuple[Symbol, Symbol]:
    """Pairs of run numbers, upper and lower, of runs that touch. Each pair is found at one pixel of
    the lower run: at the first column that both share, or where they touch at a corner only."""
    grid = words.grid
    line, (north, north_east, east, *_, west, north_west) = neighbourhood(graph, words)
    links = [first_of_runs(graph, line & north)]
    if diagonal:
        links.append(line & north_west & ~(north | west))
        links.append(line & north_east & ~(north | east))
    pixels = pixels_of(graph, graph.Concat(*links, axis=0))
    line_length = grid.words * PIXELS
    step = graph.constant(np.array([0, -1, 1], np.int32)).take(pixels.place // line_length)
    lower = pixels.place % line_length
    upper = lower - grid.pitch * PIXELS + step
    return _run_at(graph, line, pixels.layer, upper), _run_at(graph, line, pixels.layer, lower)


def _run_at(graph: Graph, line: Symbol, layer: Symbol, place: Symbol) -> Symbol:
    """Number of the run of each pixel: the count of runs that begin up to it, minus one.

    A product with `EACH_PIXEL` sums the pixels of a word in its last pixel.
    """
    highest = LAYERS * (PIXELS - 1)
    shifts = np.arange(LAYERS)[:, None]
    firsts = (first_of_runs(graph, line).reshape(1, -1) >> shifts & EACH_PIXEL).reshape(-1)
    before = graph.exclusive_sums((firsts * EACH_PIXEL & ALL) >> highest)
    word = layer * graph.length(line) + place // PIXELS
    up_to = up(firsts.take(word), highest - place % PIXELS * LAYERS)
    return before.take(word) + ((up_to * EACH_PIXEL & ALL) >> highest) - 1
