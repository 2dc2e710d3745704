"""Skeleton: thinning to convergence, all layers at once, by bitwise operations.

Both variants delete, in two alternating sub-iterations, the pixels whose eight neighbours
p2 ... p9 (N, NE, E, SE, S, SW, W, NW) satisfy the published conditions, until neither
sub-iteration deletes anything. The second is the first with the neighbours turned by half a circle.
What is outside the image is background.

ONNX Runtime takes as long for an operation on a byte as on a word. In an exported graph a word has
three pixels: the image is cut into three strips of rows, which lie in the bytes of one int32."""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import and_, or_

import torch
import torch.nn.functional as F
from torch import Tensor

from .bitplanes import neighbours, neighbours_in, steps_around, two_or_more
from .tracing import exporting, repeat_while

_BYTES = (1, 1 << 8, 1 << 16)
"""What the bytes of a word count: the first has the uppermost strip."""

Rule = Callable[[Tensor, Sequence[Tensor]], Tensor]
"""A variant of thinning: of bit-planes and their neighbours p2 ... p9, the pixels that remain after
the first sub-iteration."""


def thin(planes: Tensor, rule: Rule) -> Tensor:
    """The skeletons of bit-planes ``(B, H, W)`` uint8 by the rule `zhang_suen` or `guo_hall`."""
    if exporting():
        return _from_strips(_thinned(_in_strips(planes), rule, _neighbours_in_strips), planes)
    return _thinned(planes, rule, neighbours)


def _thinned(pixels: Tensor, rule: Rule, around: Callable[[Tensor], Sequence[Tensor]]) -> Tensor:
    """The skeletons of pixels in bytes or words, of which ``around`` gives the neighbours."""

    def iteration(pixels: Tensor) -> tuple[Tensor, Tensor]:
        first = rule(pixels, around(pixels))
        ring = around(first)
        second = rule(first, (*ring[4:], *ring[:4]))
        return (pixels ^ second).flatten().amax(0).int() > 0, second

    return repeat_while(torch.ones((), dtype=torch.bool), iteration, pixels)[0]


def _in_strips(planes: Tensor) -> Tensor:
    rows = (planes.shape[1] + 2) // 3
    padded = F.pad(planes, (0, 0, 0, 2)).int()
    strips = [padded[:, strip * rows : (strip + 1) * rows] for strip in range(3)]
    return reduce(or_, (strip * byte for strip, byte in zip(strips, _BYTES, strict=True)))


def _from_strips(words: Tensor, planes: Tensor) -> Tensor:
    strips = [words // byte & 255 for byte in _BYTES]
    return torch.cat(strips, 1)[:, : planes.shape[1]].to(torch.uint8)


def _neighbours_in_strips(words: Tensor) -> tuple[Tensor, ...]:
    """The last row of a strip is above the first one of the next."""
    above, below = (words[:, -1:] & 0xFFFF) * 256, words[:, :1] // 256
    return neighbours_in(F.pad(torch.cat([above, words, below], 1), (1, 1)))


def zhang_suen(pixels: Tensor, ring: Sequence[Tensor]) -> Tensor:
    """The first sub-iteration of Zhang & Suen, CACM 27(3), 1984.

    `thin` with it equals ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on an image padded with
    background (OpenCV never touches border pixels). ``skimage.morphology.skeletonize`` differs:
    its table deletes further patterns.

    The conditions are A(P) = 1 (one 0 -> 1 step around the pixel), 2 <= B(P) <= 6 (neighbours that
    are on), and two products that are zero. If A = 1, the neighbours that are on form one arc, in
    which corners and sides alternate, so B need not be counted: B >= 2 if the arc has a corner and
    a side. If B = 7 and the products are zero, the neighbour that is off is E or S."""
    n, ne, e, se, s, sw, w, nw = ring
    north_west, south_east = n | w, e | s
    two_on = (north_west | south_east) & (ne | se | sw | nw)
    product = e & s & north_west  # p2 p4 p6 or p4 p6 p8
    seven_on = se & (ne & ~e | sw & ~s)
    a, b, c, d = steps_around(ring)
    left, right = a ^ b, c ^ d
    one_step = (left & ~(c | d)) | (right & ~(a | b))
    return pixels & ~(one_step & two_on & ~(product | seven_on))


def guo_hall(pixels: Tensor, ring: Sequence[Tensor]) -> Tensor:
    """The first sub-iteration of algorithm A1 of Guo & Hall, CACM 32(3), 1989.

    `thin` with it equals ``skimage.morphology.thin``. OpenCV's ``THINNING_GUOHALL`` differs: it
    runs the two sub-iterations in the other order.

    The conditions are C(P) = 1 (one 8-connected group around the pixel), 2 <= N(P) <= 3 with
    N = min(N1, N2), the pairs of adjacent neighbours that are on, counted both ways, and a
    product that is zero."""
    n, ne, e, se, s, sw, w, nw = ring
    groups = [~n & (ne | e), ~e & (se | s), ~s & (sw | w), ~w & (nw | n)]
    pairs_from_nw = [nw | n, ne | e, se | s, sw | w]
    pairs_from_n = [n | ne, e | se, s | sw, w | nw]
    two_at_least = two_or_more(pairs_from_nw) & two_or_more(pairs_from_n)
    three_at_most = ~reduce(and_, pairs_from_nw + pairs_from_n)
    product = (n | ne | ~se) & e
    one_group = reduce(or_, groups) & ~two_or_more(groups)
    return pixels & ~(one_group & two_at_least & three_at_most & ~product)


RULES: dict[str, Rule] = {"zhang-suen": zhang_suen, "guo-hall": guo_hall}
