"""Sizes in pixels inside a graph, by the integer rules of `SSRVLADConfig`.

A length, an area or a squared distance times a fraction is a product of whole numbers of up to
sixty bits. int32 cannot hold it, and some runtimes divide int32 in float32. So the products are
computed from digits to the base 64, and every intermediate result is exact in float32.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..config import SSRVLADConfig
from .graph import Graph, Symbol
from .words import Grid

_MILLION = 10**6
_BASE = 64
_WHOLE = 5
"""Digits of an area."""
_PARTS = 11
"""Digits after the point. Fractions are rounded up by less than 64 ** -11; times an area of 2 ** 29
that is less than a billionth, and all exact results are multiples of a billionth."""


class Lengths(NamedTuple):
    """The settings of a config in pixels of a grid, ``()`` int32 each, and ``(N,)`` ring limits.

    A radius that is 0 on every grid is the integer 0.
    """

    opening: Symbol | int
    closing: Symbol | int
    hole_area: Symbol
    region_area: Symbol
    ring_limits: Symbol


def lengths(graph: Graph, config: SSRVLADConfig, grid: Grid) -> Lengths:
    """`SSRVLADConfig.radius_pixels`, `area_pixels` and `ring_limits` of a grid of symbols."""
    height, width = (_digits(graph, side) for side in (grid.height, grid.width))
    shorter = graph.Min(grid.height, grid.width)
    side = graph.Pad(_digits(graph, shorter).reshape(-1), [0, _WHOLE - 3])
    area = _antidiagonals(graph, height, width)
    square = _antidiagonals(graph, height, height) + _antidiagonals(graph, width, width)

    radii = [config.radius_pixels(f, _MILLION, _MILLION) for f in (config.opening, config.closing)]
    areas = [config.area_pixels(f, 1, _MILLION) for f in (config.hole_area, config.region_area)]
    limits = config.ring_limits(0, 10**9)
    rules = [(0, Fraction(parts, _MILLION), Fraction(1, 2)) for parts in radii]
    rules += [(1, Fraction(parts, _MILLION), 1 - Fraction(1, _MILLION)) for parts in areas]
    rules += [(2, Fraction(limit, 10**18), Fraction(0)) for limit in limits]
    floors = _floors(graph, graph.Concat(side, area, square, axis=0), rules)
    opening, closing = (floors[number] if parts else 0 for number, parts in enumerate(radii))
    return Lengths(opening, closing, floors[2], floors[3], floors[4:])


def _digits(graph: Graph, side: Symbol) -> Symbol:
    """``(3, 1)`` float32, the digits of a side, lowest first."""
    powers = graph.constant(np.array([[1], [_BASE], [_BASE**2]], np.int32))
    return (side // powers % _BASE).to("float32")


def _antidiagonals(graph: Graph, a: Symbol, b: Symbol) -> Symbol:
    """``(5,)`` float32, the digits of a product, without carries."""
    sums = np.zeros((9, _WHOLE), np.float32)
    for i, j in np.ndindex(3, 3):
        sums[3 * i + j, i + j] = 1
    products = a * graph.Transpose(b, perm=[1, 0])
    return graph.MatMul(products.reshape(1, -1), graph.constant(sums)).reshape(-1)


def _floors(graph: Graph, amounts: Symbol, rules: list[tuple[int, Fraction, Fraction]]) -> Symbol:
    """``(n,)`` int32, an amount times a fraction plus an offset, rounded down.

    Args:
        graph: the graph to add nodes to.
        amounts: ``(3 * 5,)`` float32, the digits of three amounts.
        rules: of each result the index of its amount, the fraction (at most 1) and the offset.
    """
    places = _PARTS + _WHOLE
    table = np.zeros((3, _WHOLE, len(rules), places), np.float32)
    start = np.zeros((len(rules), places), np.int32)
    for number, (amount, fraction, offset) in enumerate(rules):
        for digit in range(_WHOLE):
            parts = _in_digits(fraction)[: places - digit]
            table[amount, digit, number, digit : digit + len(parts)] = parts
        start[number, : _PARTS + 1] = _in_digits(offset)
    products = graph.MatMul(amounts.reshape(1, -1), graph.constant(table.reshape(3 * _WHOLE, -1)))
    digits = products.to("int32").reshape(len(rules), places) + graph.constant(start)
    lowest, *others = graph.split(digits, places, axis=1)
    for column in others[:_PARTS]:
        lowest = column + lowest // _BASE
    for place, column in enumerate(others[_PARTS:], 1):
        lowest = lowest + column * _BASE**place
    return lowest.reshape(-1)


def _in_digits(fraction: Fraction) -> npt.NDArray[np.int64]:
    """The digits of a fraction, rounded up: lowest first, the digit before the point last."""
    whole = -(-fraction * _BASE**_PARTS // 1)
    return np.array([int(whole) // _BASE**place % _BASE for place in range(_PARTS + 1)])
