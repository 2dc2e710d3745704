"""Connected regions: exact hole filling and small-region removal by area, all layers at once.

A layer is a few thousand horizontal runs rather than a million pixels. Runs that touch from row
to row are edges of a graph; the components of that graph are the regions, found by passing the
smallest run number along the edges with pointer jumping, in a few rounds however long or
winding a region is.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..bitplanes import LAYERS, Runs, paint, runs
from ..deployment.graph import Graph, Symbol
from ..deployment.words import (
    EACH_PIXEL,
    PIXELS,
    Words,
    first_of_runs,
    inside,
    neighbourhood,
    paint_in_graph,
    pixels_of,
    runs_of,
)


def fill_holes(planes: Tensor, area: int) -> Tensor:
    """Fills every enclosed hole of fewer than ``area`` pixels.

    A hole is a 4-connected background region that does not touch the border of the image.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        area: pixels; holes of this size and above stay.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    if area <= 1:
        return planes
    _, height, width = planes.shape
    gaps = runs(~planes)
    region = _regions(gaps, planes.shape, diagonal=False)
    outside = (gaps.y == 0) | (gaps.y == height - 1) | (gaps.first == 0) | (gaps.last == width - 1)
    enclosed = _total(region, outside) == 0
    return planes | _painted(gaps, enclosed & (_areas(gaps, region) < area), planes)


def drop_regions(planes: Tensor, area: int) -> Tensor:
    """Drops every 8-connected region of fewer than ``area`` pixels.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        area: pixels; regions of this size and above stay.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    if area <= 1:
        return planes
    segments = runs(planes)
    region = _regions(segments, planes.shape, diagonal=True)
    return planes & ~_painted(segments, _areas(segments, region) < area, planes)


def fill_holes_in_graph(graph: Graph, words: Words, area: Symbol) -> Words:
    """`fill_holes` in a graph. A gap at the border counts as larger than any hole to fill."""
    grid = words.grid
    background = words.with_line(inside(graph, grid) - words.line)
    gaps = runs_of(graph, background.line)
    row, first, last = grid.row(gaps.first), grid.column(gaps.first), grid.column(gaps.last)
    border = (
        row.equals(0) | row.equals(grid.height - 1) | first.equals(0) | last.equals(grid.width - 1)
    )
    sizes = _region_sizes(graph, background, gaps.length + border.to("int64") * area, False)
    return words.with_line(words.line + paint_in_graph(graph, gaps.where(sizes < area), grid))


def drop_regions_in_graph(graph: Graph, words: Words, area: Symbol) -> Words:
    """`drop_regions` in a graph."""
    segments = runs_of(graph, words.line)
    sizes = _region_sizes(graph, words, segments.length, True)
    return words.with_line(
        words.line - paint_in_graph(graph, segments.where(sizes < area), words.grid)
    )


def _region_sizes(graph: Graph, words: Words, amounts: Symbol, diagonal: bool) -> Symbol:
    """Sum of the runs' amounts over the region of each run; the regions as by `_regions`."""
    upper, lower = _touching_in_graph(graph, words, diagonal)

    def pass_on(_: Symbol, region: Symbol) -> tuple[Symbol, Symbol]:
        above, below = region.take(upper), region.take(lower)
        lowest = graph.Min(above, below)
        ends, lowest = graph.Concat(above, below, axis=0), graph.Concat(lowest, lowest, axis=0)
        hooked = graph.ScatterElements(region, ends, lowest, axis=0, reduction="min")
        jumped = hooked.take(hooked)
        return graph.any(~jumped.equals(region)), jumped

    count = graph.Size(amounts)
    (region,) = graph.repeat_while(pass_on, graph.arange(count))
    return graph.sums(region, amounts, count).take(region)


def _touching_in_graph(graph: Graph, words: Words, diagonal: bool) -> tuple[Symbol, Symbol]:
    """Pairs of runs that touch, as run numbers, each found at one pixel of the run below: at the
    first that they share, or where they touch at a corner only."""
    grid = words.grid
    line, (north, north_east, east, *_, west, north_west) = neighbourhood(graph, words)
    links = [first_of_runs(graph, line & north)]
    if diagonal:
        links.append(line & north_west & ~(north | west))
        links.append(line & north_east & ~(north | east))
    found = pixels_of(graph, graph.Concat(*links, axis=0))
    line_length = grid.words * PIXELS
    step = graph.constant(np.array([0, -1, 1])).take(found.place // line_length)
    lower = found.place % line_length
    upper = lower - grid.pitch * PIXELS + step
    return _run_at(graph, line, found.layer, upper), _run_at(graph, line, found.layer, lower)


def _run_at(graph: Graph, line: Symbol, layer: Symbol, place: Symbol) -> Symbol:
    """Number of the run that has each of the pixels: how many runs begin up to there, less one.

    A product with `EACH_PIXEL` sums the bytes of a word into its highest.
    """
    shifts = graph.constant(np.arange(LAYERS, dtype=np.uint64)[:, None])
    firsts = first_of_runs(graph, line).to("uint64").reshape(1, -1) >> shifts & EACH_PIXEL
    firsts = firsts.to("int64").reshape(-1)
    before = graph.before(firsts * EACH_PIXEL >> 56)
    word = layer * graph.Size(line) + place // PIXELS
    later = (PIXELS - 1 - place % PIXELS) * LAYERS
    up_to = (firsts.take(word) << later) * EACH_PIXEL >> 56
    return before.take(word) + up_to - 1


def _painted(segments: Runs, chosen: Tensor, planes: Tensor) -> Tensor:
    return paint(Runs(*(column[chosen] for column in segments)), planes.shape)


def _areas(segments: Runs, region: Tensor) -> Tensor:
    """Pixels of the region that each run belongs to."""
    return _total(region, segments.last - segments.first + 1)


def _total(region: Tensor, amounts: Tensor) -> Tensor:
    """Sum of the runs' amounts over the region that each run belongs to."""
    sums = torch.zeros_like(region).index_add_(0, region, amounts.to(region.dtype))
    return sums[region]


def _regions(segments: Runs, shape: torch.Size, diagonal: bool) -> Tensor:
    """For each run the number of the first run of its region."""
    upper, lower = _touching(segments, shape, diagonal)
    region = torch.arange(segments.group.numel(), device=upper.device)
    while True:
        above, below = region[upper], region[lower]
        lowest = torch.minimum(above, below)
        hooked = region.scatter_reduce(0, above, lowest, "amin")
        hooked = hooked.scatter_reduce(0, below, lowest, "amin")
        jumped = hooked[hooked]
        if torch.equal(jumped, region):
            return region
        region = jumped


def _touching(segments: Runs, shape: torch.Size, diagonal: bool) -> tuple[Tensor, Tensor]:
    """Pairs of runs that touch, as run numbers: one in some row, one in the row below it.

    All rows of all layers lie on one line, two columns apart, so the runs above a run are the
    stretch of that line between its ends, moved up one row. ``diagonal`` widens it by a column
    each side.
    """
    height, width = shape[1:]
    pitch = width + 2
    row = (segments.group * (height + 1) + segments.y + 1) * pitch + 1
    first, last = row + segments.first, row + segments.last
    reach = pitch + int(diagonal)
    begin = torch.searchsorted(last, first - reach)
    end = torch.searchsorted(first, last - pitch + int(diagonal), right=True)
    touched = (end - begin).clamp_min(0)
    lower = torch.repeat_interleave(touched)
    within = torch.arange(lower.numel(), device=lower.device) - (touched.cumsum(0) - touched)[lower]
    return begin[lower] + within, lower
