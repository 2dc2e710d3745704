"""Skeleton: thinning to convergence, all layers at once, by bitwise operations.

Both variants delete, in two alternating sub-iterations, the pixels whose eight neighbours
p2 ... p9 (N, NE, E, SE, S, SW, W, NW) satisfy the published conditions, until neither
sub-iteration deletes anything. The second is the first with the neighbours turned by half a circle.
What is outside the image is background.

The batch lies in one line of words: three pixels of a row times eight layers, the leftmost pixel in
the lowest byte. Each row ends with at least one background pixel and each image with a background
row, so the neighbours of a word are the words one pitch before and after it. Words are int32 and
never negative, and are shifted by products and quotients: these are exact also in runtimes that
compute in float32 or cut int64 to 32 bits.

A word can change only if a pixel around it changed in one of the last two sub-iterations. `thin`
processes such words only, which are called the frontier; at first they are those with a pixel that
has background N, E, S or W of it: no rule deletes another one.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import and_, or_

import torch
import torch.nn.functional as F
from torch import Tensor

from .bitplanes import steps_around, two_or_more
from .tracing import MOST, length, repeat_while

PIXELS = 3
"""Pixels of a row in a word."""

_SECOND, _THIRD, _ALL = 1 << 8, 1 << 16, (1 << 24) - 1
"""The lowest bits of the second and the third pixel of a word, and all bits."""

_RING = (3, 6, 7, 8, 5, 2, 1, 0)
"""The eight neighbours, N first and clockwise, among nine pixels that are sorted by column, then
row; n and 8 - n are opposite."""

_BLOCK = 16
"""Words of which one bool says whether any of them belongs to the frontier."""

Rule = Callable[[Tensor, Sequence[Tensor]], Tensor]
"""A variant of thinning: of words and their neighbours p2 ... p9, the pixels that remain after the
first sub-iteration."""


def thin(planes: Tensor, rule: Rule) -> Tensor:
    """The skeletons of bit-planes by the rule `zhang_suen` or `guo_hall`."""
    line, pitch = _to_line(planes)
    margin = pitch + 1
    words = line.shape[0] - 2 * margin
    inner = line[1:-1]
    west, east = _shifted(line[:-2], inner, line[2:])
    above, here, below = (slice(start, words + start) for start in (0, pitch, pitch * 2))
    border = inner[here] & ~(inner[above] & east[here] & inner[below] & west[here]) != 0
    rows = torch.stack([torch.full((), row, device=line.device) for row in (0, pitch, 2 * pitch)])
    around = rows[:, None] + torch.arange(3, device=line.device)[:, None, None]
    one_row = line.new_empty(pitch)  # an exported loop takes tensors, and no sizes

    def near(flags: Tensor, line: Tensor) -> Tensor:
        """Numbers of the words with pixels that have a flag at, above or below them."""
        pitch, words = one_row.shape[0], border.shape[0]
        above, here, below = (flags[pitch * row + 1 :][:words] for row in range(3))
        flagged = (above | here | below) & (line[pitch + 1 :][:words] != 0)
        by_block = flagged.view(-1, _BLOCK)
        blocks = by_block.to(torch.uint8).amax(1).nonzero()[:, 0]
        torch._check(blocks.shape[0] <= MOST)
        row, word = by_block.index_select(0, blocks).nonzero().unbind(1)
        return blocks.index_select(0, row) * _BLOCK + word

    def sub_iteration(
        line: Tensor, before_last: Tensor, last: Tensor, some: Tensor, order: Tensor
    ) -> tuple[Tensor, ...]:
        frontier = near(before_last | last, line)
        nine = line.index_select(0, (frontier + around).flatten())
        before, here, after = nine.view(3, 3, -1).unbind(0)
        west, east = _shifted(before, here, after)
        ring = torch.cat((west, here, east)).index_select(0, order).unbind(0)
        thinned = rule(here[1], ring)
        index, deleted = frontier + one_row.shape[0] + 1, here[1] - thinned
        line, more = line.scatter(0, index, thinned), deleted.sum() > 0
        # flagged are words with deleted pixels, and words beside them that touch a deleted pixel
        indices = torch.cat([index, index + 1, index - 1])
        changed = torch.cat([deleted > 0, deleted >= _THIRD, deleted & 255 > 0])
        flags = torch.zeros_like(line, dtype=torch.uint8)
        flags = flags.scatter_add(0, indices, changed.to(torch.uint8)).to(torch.bool)
        was = last & torch.ones_like(flags)  # an exported loop may not return what it was given
        return some | more, line, was, flags, more, 8 - order

    start = F.pad(border, (margin, margin))
    going = torch.ones((), dtype=torch.bool)
    order = torch.tensor(_RING, device=line.device)
    line = repeat_while(going, sub_iteration, line, start, start.clone(), going.clone(), order)[0]
    return _to_planes(line, pitch, planes.shape)


def zhang_suen(pixels: Tensor, ring: Sequence[Tensor]) -> Tensor:
    """The first sub-iteration of Zhang & Suen, CACM 27(3), 1984.

    `thin` with it equals ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on an image padded with
    background (OpenCV never touches border pixels). ``skimage.morphology.skeletonize`` differs:
    its table deletes further patterns.

    The conditions are A(P) = 1 (one 0 -> 1 step around the pixel), 2 <= B(P) <= 6 (neighbours that
    are on), and two products that are zero. If A = 1, the neighbours that are on form one arc, in
    which corners and sides alternate, so B need not be counted: B >= 2 if the arc has a corner and
    a side. If B = 7 and the products are zero, the neighbour that is off is E or S. Subtraction
    removes a subset of bits.
    """
    n, ne, e, se, s, sw, w, nw = ring
    north_west, south_east = n | w, e | s
    two_on = (north_west | south_east) & (ne | se | sw | nw)
    product = e & s & north_west  # p2 p4 p6 or p4 p6 p8
    seven_on = se & ((ne | e) - e | sw - (s & sw))
    a, b, c, d = steps_around(ring)
    left, right = a ^ b, c ^ d
    one_step = (left - (left & (c | d))) | (right - (right & (a | b)))
    return pixels - (pixels & one_step & two_on & ~(product | seven_on))


def guo_hall(pixels: Tensor, ring: Sequence[Tensor]) -> Tensor:
    """The first sub-iteration of algorithm A1 of Guo & Hall, CACM 32(3), 1989.

    `thin` with it equals ``skimage.morphology.thin``. OpenCV's ``THINNING_GUOHALL`` differs: it
    runs the two sub-iterations in the other order.

    The conditions are C(P) = 1 (one 8-connected group around the pixel), 2 <= N(P) <= 3 with
    N = min(N1, N2), the pairs of adjacent neighbours that are on, counted both ways, and a
    product that is zero.
    """
    n, ne, e, se, s, sw, w, nw = ring
    groups = [~n & (ne | e), ~e & (se | s), ~s & (sw | w), ~w & (nw | n)]
    one = [nw | n, ne | e, se | s, sw | w]
    other = [n | ne, e | se, s | sw, w | nw]
    two_at_least = two_or_more(one) & two_or_more(other)
    three_at_most = ~reduce(and_, one + other)
    product = (n | ne | ~se) & e
    one_group = reduce(or_, groups) & ~two_or_more(groups)
    return pixels & ~(one_group & two_at_least & three_at_most & ~product)


RULES: dict[str, Rule] = {"zhang-suen": zhang_suen, "guo-hall": guo_hall}


def _to_line(planes: Tensor) -> tuple[Tensor, int]:
    """``(L + 2 * (pitch + 1),)`` int32 words with margins of background, and words per row; L is a
    multiple of `_BLOCK`."""
    width = planes.shape[2]
    pitch = width // PIXELS + 1
    pixels = F.pad(planes, (0, pitch * PIXELS - width, 0, 1)).reshape(-1, PIXELS).int()
    line = pixels[:, 0] + pixels[:, 1] * _SECOND + pixels[:, 2] * _THIRD
    whole = length((line.shape[0] + _BLOCK - 1) // _BLOCK) * _BLOCK
    return F.pad(line, (pitch + 1, pitch + 1 + whole - line.shape[0])), pitch


def _to_planes(line: Tensor, pitch: int, shape: torch.Size) -> Tensor:
    count, height, width = shape
    words = line[pitch + 1 :][: count * (height + 1) * pitch]
    pixels = torch.stack([words & 255, words // _SECOND & 255, words // _THIRD], 1)
    rows = pixels.to(torch.uint8).view(count, height + 1, pitch * PIXELS)
    return rows[:, :height, :width].contiguous()


def _shifted(before: Tensor, here: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Two sets of words: their pixels are the west, and the east, neighbours of those of `here`."""
    west = (here * _SECOND & _ALL) + before // _THIRD
    east = here // _SECOND + (after * _THIRD & _ALL)
    return west, east
