"""Sizes in pixels inside a graph, by the integer rules of `SSRVLADConfig`.

A length, an area or a squared distance times a fraction is a product of whole numbers of up to
sixty bits. int32 cannot hold it, so it is divided in two steps, as by hand, see `Graph.divided`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..config import SSRVLADConfig
from .graph import Graph, Symbol
from .words import Grid

_MILLION = 10**6
_BILLION = 10**9
_BASE = 1 << 12


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
    height, width = grid.height, grid.width
    radii = [config.radius_pixels(f, _MILLION, _MILLION) for f in (config.opening, config.closing)]
    areas = [config.area_pixels(f, 1, _MILLION) for f in (config.hole_area, config.region_area)]
    limits = config.ring_limits(30_000, 10_000)  # the squares of these sides sum to a billion
    shorter = graph.Min(height, width)
    pixels = _floors(graph, shorter, radii, _MILLION, _MILLION // 2)
    opening, closing = (pixels[number] if parts else 0 for number, parts in enumerate(radii))
    areas_in_pixels = _floors(graph, height * width, areas, _MILLION, _MILLION - 1)
    diagonal = height * height + width * width
    ring_limits = _floors(graph, diagonal, limits, _BILLION)
    return Lengths(opening, closing, areas_in_pixels[0], areas_in_pixels[1], ring_limits)


def _floors(
    graph: Graph, amount: Symbol, parts: Sequence[int], unit: int, offset: int = 0
) -> Symbol:
    """``(n,)`` int32, ``(parts * amount + offset) / unit`` rounded down.

    Args:
        graph: the graph to add nodes to.
        amount: ``()`` int32, not negative.
        parts: n whole numbers up to the unit.
        unit: at most a billion.
        offset: below the unit.
    """
    whole = graph.constant(np.array(parts, np.int32))
    share = graph.constant((np.array(parts) / unit).astype(np.float32))
    high = amount // _BASE
    low = amount - high * _BASE
    first, rest = graph.divided(whole * high, share * high.to("float32"), unit)
    estimate = rest.to("float32") * (_BASE / unit) + share * low.to("float32") + offset / unit
    second, _ = graph.divided(rest * _BASE + whole * low + offset, estimate, unit)
    return first * _BASE + second
