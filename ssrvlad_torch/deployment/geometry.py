"""Sizes in pixels inside a graph, by the integer rules of `SSRVLADConfig`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from ..config import SSRVLADConfig
from .graph import Graph, Symbol
from .words import Grid

_MILLION = 10**6


def working_grid(
    graph: Graph, working_size: int, height: Symbol, width: Symbol
) -> tuple[Symbol, Symbol]:
    """`SSRVLADConfig.grid` of ``()`` int64 symbols."""
    shorter = graph.Min(height, width)
    kept = graph.Min(shorter, working_size)
    return _rounded(height * kept, shorter), _rounded(width * kept, shorter)


def radius_pixels(graph: Graph, config: SSRVLADConfig, fraction: float, grid: Grid) -> Symbol | int:
    """`SSRVLADConfig.radius_pixels` of a grid of symbols; 0 if it is 0 for every size."""
    millionths = config.radius_pixels(fraction, _MILLION, _MILLION)
    return millionths and _rounded(graph.Min(grid.height, grid.width) * millionths, _MILLION)


def area_pixels(config: SSRVLADConfig, fraction: float, grid: Grid) -> Symbol:
    """`SSRVLADConfig.area_pixels` of a grid of symbols."""
    millionths = config.area_pixels(fraction, 1, _MILLION)
    return (grid.height * grid.width * millionths + _MILLION - 1) // _MILLION


def ring_limits(config: SSRVLADConfig, grid: Grid) -> Sequence[Symbol]:
    """`SSRVLADConfig.ring_limits`, whose formula does for symbols as it stands."""
    sizes = cast(tuple[int, int], (grid.height, grid.width))
    return cast(tuple[Symbol, ...], config.ring_limits(*sizes))


def _rounded(numerator: Symbol, denominator: Symbol | int) -> Symbol:
    return (numerator * 2 + denominator) // (denominator * 2)
