"""Connected regions: exact hole filling and small-region removal by area, all layers at once.

A layer is stored as a few thousand horizontal runs instead of a million pixels. Two runs that touch
from row to row form an edge of a graph, whose connected components are the regions. Minimum-label
propagation with pointer jumping finds them in a few rounds, also for long and winding regions."""

import torch
import torch.nn.functional as F
from torch import Tensor

from .bitplanes import LAYERS, Runs, paint, repeated, runs
from .tracing import exporting, repeat_while


def fill_holes(planes: Tensor, area: int | Tensor) -> Tensor:
    """Bit-planes with every hole of fewer than ``area`` pixels filled. A hole is a 4-connected
    background region that does not touch the border of the image."""
    if isinstance(area, int) and area <= 1:
        return planes
    _, height, width = planes.shape
    gaps = runs(~planes)
    region = _regions(gaps, planes.shape, diagonal=False)
    outside = (gaps.y == 0) | (gaps.y == height - 1) | (gaps.first == 0) | (gaps.last == width - 1)
    enclosed = _total(region, outside) == 0
    small = _total(region, gaps.length) < area
    return planes | _paint_where(enclosed & small, gaps, planes.shape)


def drop_regions(planes: Tensor, area: int | Tensor) -> Tensor:
    """Bit-planes without the 8-connected regions of fewer than ``area`` pixels."""
    if isinstance(area, int) and area <= 1:
        return planes
    segments = runs(planes)
    region = _regions(segments, planes.shape, diagonal=True)
    small = _total(region, segments.length) < area
    return planes & ~_paint_where(small, segments, planes.shape)


def _paint_where(chosen: Tensor, segments: Runs, shape: torch.Size) -> Tensor:
    index = chosen.nonzero()[:, 0]
    return paint(Runs(*(column.index_select(0, index) for column in segments)), shape)


def _total(region: Tensor, values: Tensor) -> Tensor:
    """Sum of the values of all runs of each run's region."""
    sums = torch.zeros_like(region).scatter_add(0, region, values.to(region.dtype))
    return sums.index_select(0, region)


def _regions(segments: Runs, shape: torch.Size, diagonal: bool) -> Tensor:
    """For each run, the number of the first run of its region."""
    upper, lower = _touching(segments, shape, diagonal)

    def propagate(region: Tensor) -> tuple[Tensor, Tensor]:
        above, below = (region.index_select(0, ends) for ends in (upper, lower))
        lowest = torch.minimum(above, below)
        hooked = region.scatter_reduce(0, above, lowest, "amin")
        hooked = hooked.scatter_reduce(0, below, lowest, "amin")
        jumped = hooked.index_select(0, hooked)
        return (jumped != region).sum() > 0, jumped  # any() of nothing is true in some runtimes

    numbers = torch.arange(segments.group.numel(), device=upper.device)
    return repeat_while(torch.ones((), dtype=torch.bool), propagate, numbers)[0]


def _touching(segments: Runs, shape: torch.Size, diagonal: bool) -> tuple[Tensor, Tensor]:
    """Pairs of runs that touch, as run numbers: the upper run and the run in the row below it.

    All rows of all layers are placed on one line, two columns apart. The runs above a run are those
    between its two ends, moved up by one row. ``diagonal`` widens this stretch by one column on
    each side."""
    count, height, width = shape
    pitch = width + 2
    row = (segments.group * (height + 1) + segments.y + 1) * pitch + 1
    first, last = row + segments.first, row + segments.last
    reach = pitch + int(diagonal)
    ends = torch.cat((first - reach, last - pitch + int(diagonal)))
    if exporting():  # without searchsorted: the number of runs up to each place
        length = (LAYERS * count * (height + 1) + 1) * pitch
        ones = torch.ones_like(first, dtype=torch.int32)
        marks = torch.zeros(length, dtype=torch.int32).scatter_add(0, first, ones)
        up_to = marks.cumsum(0, dtype=torch.int32).index_select(0, ends).long()
    else:
        up_to = torch.searchsorted(first, ends, right=True)
    begin, end = up_to.view(2, -1).unbind()
    at_or_left = F.pad(last, (1, 0), value=-1).index_select(0, begin)  # where the run before ends
    begin = begin - (at_or_left >= first - reach).long()
    lower, within = repeated((end - begin).clamp_min(0))
    return begin.index_select(0, lower) + within, lower
