"""Skeleton: thinning to convergence, all layers at once, by bitwise operations.

Both variants delete, in two alternating sub-iterations, the pixels whose eight neighbours
p2 ... p9 (N, NE, E, SE, S, SW, W, NW) satisfy the published conditions, until neither
sub-iteration deletes anything. What is outside the image is background.
"""

from __future__ import annotations

from torch import Tensor

from ..bitplanes import neighbours


def thin(planes: Tensor, variant: str) -> Tensor:
    """The skeleton of every layer.

    ``"zhang-suen"`` is Zhang & Suen, CACM 27(3), 1984, and equals
    ``cv2.ximgproc.thinning(THINNING_ZHANGSUEN)`` on an image padded with background (OpenCV
    never touches border pixels). ``skimage.morphology.skeletonize`` differs: its table deletes
    further patterns.

    ``"guo-hall"`` is algorithm A1 of Guo & Hall, CACM 32(3), 1989, and equals
    ``skimage.morphology.thin``. OpenCV's ``THINNING_GUOHALL`` differs: it runs the two
    sub-iterations in the other order.

    Args:
        planes: ``(B, H, W)`` uint8 bit-planes.
        variant: ``"zhang-suen"`` or ``"guo-hall"``.

    Returns:
        ``(B, H, W)`` uint8 bit-planes.
    """
    deletable = {"zhang-suen": zhang_suen, "guo-hall": guo_hall}[variant]
    while True:
        half = planes & ~deletable(planes, first=True)
        thinner = half & ~deletable(half, first=False)
        if bool((thinner == planes).all()):
            return planes
        planes = thinner


def zhang_suen(planes: Tensor, first: bool) -> Tensor:
    """Pixels that one sub-iteration of Zhang-Suen deletes (or background, which has none).

    The conditions are A(P) = 1 (one 0 -> 1 step around the pixel) and 2 <= B(P) <= 6 (neighbours
    that are on), and two products that are zero. Given A = 1 the neighbours that are on form one
    arc, so B >= 2 says that two in a row are on, and B <= 6 that two in a row are off.
    """
    ring = neighbours(planes)
    following = ring[1:] + ring[:1]
    pairs = [here & there for here, there in zip(ring, following, strict=True)]
    steps = [there & ~here for here, there in zip(ring, following, strict=True)]
    two_on = _any(pairs)
    two_off = ~_all([here | there for here, there in zip(ring, following, strict=True)])
    north, _, east, _, south, _, west, _ = ring
    if first:
        kept = east & south & (north | west)  # p2 p4 p6 = 0 and p4 p6 p8 = 0
    else:
        kept = north & west & (east | south)  # p2 p4 p8 = 0 and p2 p6 p8 = 0
    return _exactly_one(steps) & two_on & two_off & ~kept


def guo_hall(planes: Tensor, first: bool) -> Tensor:
    """Pixels that one sub-iteration of Guo-Hall deletes (or background, which has none).

    The conditions are C(P) = 1 (one 8-connected group around the pixel), 2 <= N(P) <= 3 with
    N = min(N1, N2), the pairs of adjacent neighbours that are on, counted both ways, and a
    product that is zero.
    """
    n, ne, e, se, s, sw, w, nw = neighbours(planes)
    groups = [~n & (ne | e), ~e & (se | s), ~s & (sw | w), ~w & (nw | n)]
    one = [nw | n, ne | e, se | s, sw | w]
    other = [n | ne, e | se, s | sw, w | nw]
    two_or_more = _two_or_more(one) & _two_or_more(other)
    three_or_fewer = ~(_all(one) & _all(other))
    kept = (n | ne | ~se) & e if first else (s | sw | ~nw) & w
    return _exactly_one(groups) & two_or_more & three_or_fewer & ~kept


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
