"""Bit-planes: all eight layers of an image in one byte per pixel.

``planes``, here and in the stages, is a ``(B, H, W)`` uint8 tensor whose bit ``k`` is layer ``k``.
Set operations on all layers at once are bitwise operations, neighbours are slices, and only the few
bytes that are not zero are read to list pixels or runs.

Lists are grouped: group ``k * B + b`` is layer ``k`` of image ``b``. Every list is sorted by group,
then in raster order. `by_image` turns a value per group into a value per image."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .tracing import MOST, exporting, number_in

LAYERS = 8


class Points(NamedTuple):
    """Pixels of the layers, one entry each: ``group``, row ``y`` and column ``x``, all int64."""

    group: Tensor
    y: Tensor
    x: Tensor


class Runs(NamedTuple):
    """Maximal horizontal runs of the layers, one entry each, all int64.

    ``first`` and ``last`` are the columns of the first and the last pixel."""

    group: Tensor
    y: Tensor
    first: Tensor
    last: Tensor

    @property
    def length(self) -> Tensor:
        """The number of pixels of each run."""
        return self.last - self.first + 1


def unpack(planes: Tensor) -> Tensor:
    """``(B, H, W)`` uint8 bit-planes -> ``(B, 8, H, W)`` bool layers."""
    return (planes[:, None] & _bits(planes).view(LAYERS, 1, 1)).bool()


def _bits(like: Tensor, dtype: torch.dtype = torch.uint8) -> Tensor:
    return torch.tensor([1 << k for k in range(LAYERS)], dtype=dtype, device=like.device)


def neighbours(planes: Tensor) -> tuple[Tensor, ...]:
    """The eight neighbours of every pixel: N, NE, E, SE, S, SW, W, NW, each ``(B, H, W)``.

    This is the order p2 ... p9 of the thinning papers. What is outside the image is background."""
    return neighbours_in(F.pad(planes, (1, 1, 1, 1)))


def neighbours_in(padded: Tensor) -> tuple[Tensor, ...]:
    """The same of planes with a margin of one pixel, ``(B, H + 2, W + 2)``."""
    before, here, after = slice(-2), slice(1, -1), slice(2, None)
    above, level, below = padded[:, before], padded[:, here], padded[:, after]
    return (
        *(above[..., here], above[..., after], level[..., after], below[..., after]),
        *(below[..., here], below[..., before], level[..., before], above[..., before]),
    )


def two_or_more(planes: Sequence[Tensor]) -> Tensor:
    """Bits that are set in at least two of two or more planes."""
    once, twice = planes[0] | planes[1], planes[0] & planes[1]
    for plane in planes[2:]:
        once, twice = once | plane, twice | (once & plane)
    return twice


def steps_around(ring: Sequence[Tensor]) -> list[Tensor]:
    """The 0 -> 1 steps around every pixel, from its eight `neighbours`, in four planes; their sum
    is the crossing number.

    There is at most one step from N over NE to E, and in each of the other quarters."""
    n, ne, e, se, s, sw, w, nw = ring
    return [(ne | e) ^ (n & ne), (se | s) ^ (e & se), (sw | w) ^ (s & sw), (nw | n) ^ (w & nw)]


def points(planes: Tensor) -> Points:
    """The pixels of every layer."""
    image, y, x = planes.nonzero().unbind(1)
    torch._check(image.shape[0] <= MOST)
    place = (image * planes.shape[1] + y) * planes.shape[2] + x
    bits = _bits(planes)[:, None]
    layer, entry = (planes.flatten().index_select(0, place) & bits).nonzero().unbind(1)
    image, y, x = (places.index_select(0, entry) for places in (image, y, x))
    return Points(layer * planes.shape[0] + image, y, x)


def runs(planes: Tensor) -> Runs:
    """The runs of every layer: a run starts where the pixel to its left is off."""
    padded = F.pad(planes, (1, 1))
    first, last = points(planes & ~padded[..., :-2]), points(planes & ~padded[..., 2:])
    return Runs(first.group, first.y, first.x, last.x)


def paint(chosen: Runs, shape: torch.Size) -> Tensor:
    """Bit-planes of a shape ``(B, H, W)`` in which exactly the given runs are set."""
    count, height, width = shape
    device = chosen.group.device
    layer = chosen.group // torch.full((), count, device=device)  # not the size: it is exported
    row = ((chosen.group - layer * count) * height + chosen.y) * (width + 1)
    bit = _bits(row, torch.int32).index_select(0, layer)
    steps = torch.zeros(count * height * (width + 1), dtype=torch.int32, device=device)
    steps = steps.scatter_add(0, row + chosen.first, bit)
    steps = steps.scatter_add(0, row + chosen.last + 1, -bit).view(count, height, width + 1)
    return steps.cumsum(2, dtype=torch.int32)[..., :width].to(torch.uint8)


def repeated(times: Tensor) -> tuple[Tensor, Tensor]:
    """Repeats the number n ``times[n]`` times: the numbers, and for each entry the count of equal
    entries before it, ``(m,)`` int64 each."""
    if not exporting():
        number = torch.repeat_interleave(times)
        within = torch.arange(number.numel(), device=number.device)
        return number, within - (times.cumsum(0) - times)[number]
    ends = F.pad(times.cumsum(0), (1, 0))
    total, ones = number_in(ends[-1]), torch.ones_like(times)
    starts = torch.zeros(total + 1, dtype=torch.int64).scatter_add(0, ends[1:], ones)
    number = starts[:total].cumsum(0)
    return number, torch.arange(total) - ends.index_select(0, number)


def sums_of_groups(amounts: Tensor, group: Tensor, images: int) -> Tensor:
    """``(8 * B,)``, the sum of the amounts of the entries of each group."""
    return amounts.new_zeros(LAYERS * images).scatter_add(0, group, amounts)


def count_groups(pixels: Points, images: int) -> Tensor:
    """``(8 * B,)`` int64, the number of points of each group."""
    return sums_of_groups(torch.ones_like(pixels.group), pixels.group, images)


def by_image(values: Tensor, images: int) -> Tensor:
    """``(8 * B, ...)`` values by group -> ``(B, 8, ...)``."""
    return values.view(LAYERS, images, *values.shape[1:]).transpose(0, 1)
