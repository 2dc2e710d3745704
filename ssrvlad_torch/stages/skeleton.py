"""Skeleton: thinning to convergence, all layers at once, by bitwise operations.

Both variants delete, in two alternating sub-iterations, the pixels whose eight neighbours
p2 ... p9 (N, NE, E, SE, S, SW, W, NW) satisfy the published conditions, until neither
sub-iteration deletes anything. What is outside the image is background.

The batch is laid out as one line of bytes, each row followed by a background pixel and each
image by a background row. A neighbour is then the same line a few bytes further on, so that a
sub-iteration is one pass over contiguous memory, and one fused loop when it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

SubIteration = Callable[[Tensor, int, bool], Tensor]
"""``(line, pitch, first) ->`` what is left of the line after a sub-iteration; see `zhang_suen`."""


def thin(planes: Tensor, sub_iteration: SubIteration) -> Tensor:
    """The skeleton of every layer.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        sub_iteration: `zhang_suen`, `guo_hall`, or one of them compiled.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    count, height, width = planes.shape
    pitch = width + 1
    margin = pitch + 1
    line = F.pad(F.pad(planes, (0, 1, 0, 1)).flatten(), (margin, margin))
    pixels = line[margin:-margin]
    settled = False
    while not settled:
        settled = True
        for first in (True, False):
            left = sub_iteration(line, pitch, first)
            settled &= torch.equal(left, pixels)
            pixels.copy_(left)
    return pixels.view(count, height + 1, pitch)[:, :height, :width].contiguous()


def zhang_suen(line: Tensor, pitch: int, first: bool) -> Tensor:
    """One sub-iteration of Zhang & Suen, CACM 27(3), 1984.

    `thin` with it equals ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on an image padded with
    background (OpenCV never touches border pixels). ``skimage.morphology.skeletonize`` differs:
    its table deletes further patterns.

    The conditions are A(P) = 1 (one 0 -> 1 step around the pixel) and 2 <= B(P) <= 6 (neighbours
    that are on), and two products that are zero. Given A = 1 the neighbours that are on form one
    arc, so B >= 2 says that two in a row are on, and B <= 6 that two in a row are off.

    Args:
        line: ``(L + 2 * (pitch + 1),)`` uint8 bit-planes in one line, with a margin at each end.
        pitch: pixels from one row to the next.
        first: which of the two sub-iterations.

    Returns:
        ``(L,)`` uint8, the pixels within the margins that are left.
    """
    pixels, ring = _neighbourhood(line, pitch)
    following = ring[1:] + ring[:1]
    around = list(zip(ring, following, strict=True))
    two_on = _any([here & there for here, there in around])
    two_off = ~_all([here | there for here, there in around])
    steps = [there & ~here for here, there in around]
    north, _, east, _, south, _, west, _ = ring
    if first:
        kept = east & south & (north | west)  # p2 p4 p6 = 0 and p4 p6 p8 = 0
    else:
        kept = north & west & (east | south)  # p2 p4 p8 = 0 and p2 p6 p8 = 0
    return pixels & ~(_exactly_one(steps) & two_on & two_off & ~kept)


def guo_hall(line: Tensor, pitch: int, first: bool) -> Tensor:
    """One sub-iteration of algorithm A1 of Guo & Hall, CACM 32(3), 1989.

    `thin` with it equals ``skimage.morphology.thin``. OpenCV's ``THINNING_GUOHALL`` differs: it
    runs the two sub-iterations in the other order.

    The conditions are C(P) = 1 (one 8-connected group around the pixel), 2 <= N(P) <= 3 with
    N = min(N1, N2), the pairs of adjacent neighbours that are on, counted both ways, and a
    product that is zero. Arguments and result as for `zhang_suen`.
    """
    pixels, (n, ne, e, se, s, sw, w, nw) = _neighbourhood(line, pitch)
    groups = [~n & (ne | e), ~e & (se | s), ~s & (sw | w), ~w & (nw | n)]
    one = [nw | n, ne | e, se | s, sw | w]
    other = [n | ne, e | se, s | sw, w | nw]
    two_or_more = _two_or_more(one) & _two_or_more(other)
    three_or_fewer = ~(_all(one) & _all(other))
    kept = (n | ne | ~se) & e if first else (s | sw | ~nw) & w
    return pixels & ~(_exactly_one(groups) & two_or_more & three_or_fewer & ~kept)


SUB_ITERATIONS: dict[str, SubIteration] = {"zhang-suen": zhang_suen, "guo-hall": guo_hall}


def _neighbourhood(line: Tensor, pitch: int) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The pixels within the margins, and their neighbours N, NE, E, SE, S, SW, W, NW."""
    margin = pitch + 1
    length = line.shape[0] - 2 * margin
    offsets = (-pitch, 1 - pitch, 1, pitch + 1, pitch, pitch - 1, -1, -pitch - 1)
    starts = [margin + offset for offset in offsets]
    return line[margin : margin + length], tuple(line[start : start + length] for start in starts)


def _any(planes: list[Tensor]) -> Tensor:
    result = planes[0]
    for plane in planes[1:]:
        result = result | plane
    return result


def _all(planes: list[Tensor]) -> Tensor:
    result = planes[0]
    for plane in planes[1:]:
        result = result & plane
    return result


def _exactly_one(planes: list[Tensor]) -> Tensor:
    return _any(planes) & ~_two_or_more(planes)


def _two_or_more(planes: list[Tensor]) -> Tensor:
    seen, again = planes[0], planes[0] ^ planes[0]
    for plane in planes[1:]:
        seen, again = seen | plane, again | (seen & plane)
    return again
