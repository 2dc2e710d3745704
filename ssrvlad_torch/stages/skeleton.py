"""Skeleton: thinning to convergence, all layers at once, by bitwise operations.

Both variants delete, in two alternating sub-iterations, the pixels whose eight neighbours
p2 ... p9 (N, NE, E, SE, S, SW, W, NW) satisfy the published conditions, until neither
sub-iteration deletes anything. What is outside the image is background.

The batch lies in one line of 64-bit words: a word is eight pixels of a row times eight layers, the
leftmost pixel in the lowest byte. Each row ends with at least one background pixel and each image
with a background row, so the neighbours of a word are the words one pitch before and after it,
and the pixels beside a pixel are a byte's shift away.

A word can change only if a word around it changed in one of the last two sub-iterations. After the
first two, `thin` processes such words only: most of an image is final early.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import and_, or_
from typing import Protocol

import torch
from torch import Tensor

from .bitplanes import Bits, line_neighbours, steps_around, two_or_more

PIXELS = 8
"""Pixels of a row in a word."""

Ring = tuple[Tensor, ...]

_ALL_BUT_TOP_BYTE = (1 << 56) - 1


class Rule(Protocol):
    """A variant of thinning."""

    def __call__(self, pixels: Bits, ring: tuple[Bits, ...], first: bool, /) -> Bits:
        """The pixels that remain after the first or the second sub-iteration."""


def thin(planes: Tensor, rule: Rule) -> Tensor:
    """The skeleton of every layer.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        rule: `zhang_suen` or `guo_hall`.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    line, pitch = _to_line(planes)
    pixels = _within_margins(line, pitch)
    changed = []
    for first in (True, False):
        length = line.shape[0] - 2 * (pitch + 1)
        remaining = rule(*line_neighbours(line, pitch, length, _shifted), first)
        changed.append((remaining != pixels).nonzero()[:, 0] + pitch + 1)
        pixels.copy_(remaining)
    while len(changed[0]) + len(changed[1]):
        for first in (True, False):
            frontier = _around(torch.cat(changed), line, pitch)
            centre, ring = _neighbourhood_of(frontier, line, pitch)
            remaining = rule(centre, ring, first)
            line[frontier] = remaining
            changed = [changed[1], frontier[remaining != centre]]
    return _to_planes(line, pitch, planes.shape)


def zhang_suen(pixels: Bits, ring: tuple[Bits, ...], first: bool) -> Bits:
    """One sub-iteration of Zhang & Suen, CACM 27(3), 1984.

    `thin` with it equals ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on an image padded with
    background (OpenCV never touches border pixels). ``skimage.morphology.skeletonize`` differs:
    its table deletes further patterns.

    The conditions are A(P) = 1 (one 0 -> 1 step around the pixel), 2 <= B(P) <= 6 (neighbours that
    are on), and two products that are zero. If A = 1, the neighbours that are on form one arc, in
    which corners and sides alternate, so B need not be counted: B >= 2 if the arc has a corner and
    a side. If B = 7 and the products are zero, the neighbour that is off is E or S in the first
    sub-iteration, W or N in the second. Subtraction removes a subset of bits.

    Args:
        pixels: `Bits`: a tensor, or a symbol of a graph.
        ring: p2 ... p9, each of the type of ``pixels``.
        first: whether it is the first of the two sub-iterations.

    Returns:
        The pixels that remain.
    """
    n, ne, e, se, s, sw, w, nw = ring
    north_west, south_east = n | w, e | s
    two_on = (north_west | south_east) & (ne | se | sw | nw)
    if first:
        product = e & s & north_west  # p2 p4 p6 or p4 p6 p8
        seven_on = se & ((ne | e) - e | sw - (s & sw))
    else:
        product = n & w & south_east  # p2 p4 p8 or p2 p6 p8
        seven_on = nw & ((sw | w) - w | ne - (n & ne))
    return pixels - (pixels & _exactly_one(steps_around(ring)) & two_on & ~(product | seven_on))


def guo_hall(pixels: Bits, ring: tuple[Bits, ...], first: bool) -> Bits:
    """One sub-iteration of algorithm A1 of Guo & Hall, CACM 32(3), 1989.

    `thin` with it equals ``skimage.morphology.thin``. OpenCV's ``THINNING_GUOHALL`` differs: it
    runs the two sub-iterations in the other order.

    The conditions are C(P) = 1 (one 8-connected group around the pixel), 2 <= N(P) <= 3 with
    N = min(N1, N2), the pairs of adjacent neighbours that are on, counted both ways, and a
    product that is zero. Arguments and result as for `zhang_suen`.
    """
    n, ne, e, se, s, sw, w, nw = ring
    groups = [~n & (ne | e), ~e & (se | s), ~s & (sw | w), ~w & (nw | n)]
    one = [nw | n, ne | e, se | s, sw | w]
    other = [n | ne, e | se, s | sw, w | nw]
    two_at_least = two_or_more(one) & two_or_more(other)
    three_at_most = ~reduce(and_, one + other)
    product = (n | ne | ~se) & e if first else (s | sw | ~nw) & w
    one_group = reduce(or_, groups) & ~two_or_more(groups)
    return pixels & ~(one_group & two_at_least & three_at_most & ~product)


RULES: dict[str, Rule] = {"zhang-suen": zhang_suen, "guo-hall": guo_hall}


def _to_line(planes: Tensor) -> tuple[Tensor, int]:
    """``(L + 2 * (pitch + 1),)`` int64 words with margins of background, and words per row."""
    count, height, width = planes.shape
    pitch = width // PIXELS + 1
    length = count * (height + 1) * pitch
    line = torch.zeros(length + 2 * (pitch + 1), dtype=torch.int64, device=planes.device)
    rows = _within_margins(line, pitch).view(torch.uint8).view(count, height + 1, -1)
    rows[:, :height, :width] = planes
    return line, pitch


def _to_planes(line: Tensor, pitch: int, shape: torch.Size) -> Tensor:
    count, height, width = shape
    rows = _within_margins(line, pitch).view(torch.uint8).view(count, height + 1, -1)
    return rows[:, :height, :width].contiguous()


def _within_margins(line: Tensor, pitch: int) -> Tensor:
    return line[pitch + 1 : line.shape[0] - pitch - 1]


def _neighbourhood_of(index: Tensor, line: Tensor, pitch: int) -> tuple[Tensor, Ring]:
    """The words at an index and the neighbours of their pixels."""
    rows = torch.tensor((-pitch, 0, pitch), device=line.device)[:, None] + index
    words = [line.index_select(0, rows.flatten() + step).view(3, -1) for step in (-1, 0, 1)]
    west, east = _shifted(*words)
    here = words[1]
    return here[1], (here[0], east[0], east[1], east[2], here[2], west[2], west[1], west[0])


def _shifted(before: Tensor, here: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Two sets of words: their pixels are the west, and the east, neighbours of those of `here`."""
    west = here << 8 | (before >> 56 & 255)
    east = (here >> 8 & _ALL_BUT_TOP_BYTE) | after << 56
    return west, east


def _around(changed: Tensor, line: Tensor, pitch: int) -> Tensor:
    """Indices of the words that changed and of those around them, each once, in order."""
    near = torch.zeros_like(line, dtype=torch.bool)
    for row in (-pitch, 0, pitch):
        for step in (-1, 0, 1):
            near[changed + (row + step)] = True
    return _within_margins(near, pitch).nonzero()[:, 0] + pitch + 1


def _exactly_one(planes: Sequence[Bits]) -> Bits:
    """Bits that are set in exactly one of four planes: in one of a pair and none of the other."""
    a, b, c, d = planes
    one, other = a ^ b, c ^ d
    return (one - (one & (c | d))) | (other - (other & (a | b)))
