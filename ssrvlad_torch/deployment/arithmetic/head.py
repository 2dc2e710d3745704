"""The head as arithmetic: what `SSRVLAD.forward` does for the aggregation harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS, SSRVLADConfig
from ...stages.boundaries import WIDTH
from ...stages.grid_pooling import ROWS
from ...stages.harmonics import harmonic_tables
from ...stages.layers import category_table
from ...taxonomy import NO_LAYER, label_space
from ..geometry import working_grid
from ..graph import Graph, Symbol
from ..stages.harmonics import coefficients_in_graph, harmonics_in_graph
from ..stages.layers import entries_in_graph
from .boundaries import boundaries_in_graph
from .grid_pooling import pool_in_graph
from .layers import Layers, layers_in_graph
from .reduction import KINDS, RADIX, WIDEST_CELL, side_of, votes_in_graph
from .vanishing_column import WIDEST, vanishing_columns_in_graph


class _Seen(NamedTuple):
    """The layers of a batch, ``(B,)`` unknown ids, and ``()`` bool, whether a cell has more pixels
    than can be counted."""

    layers: Layers
    unknown: Symbol
    too_large: Symbol


def describe_in_arithmetic(
    graph: Graph, labels: Symbol, config: SSRVLADConfig, columns: Sequence[int] = ()
) -> dict[str, Symbol]:
    """`SSRVLAD.forward` in a graph, or `SSRVLAD.sweep`, for the aggregation harmonics.

    Args:
        graph: where the nodes go.
        labels: ``(B, H, W)`` uint8, int32 or int64 label ids, any of the sizes dynamic.
        config: the settings.
        columns: S anchors of a sweep, for descriptors ``(B, S, 480)``; none for single ones.

    Returns:
        ``descriptor (B, 480)`` float32, NaN where sums would not be exact: of a grid wider than
        `WIDEST`, or cells wider than `WIDEST_CELL`; and ``unknown (B,)`` float32.
    """
    with graph.stage("layers"):
        layers, unknown, too_large = _layers(graph, labels, config)
    descriptor = harmonics_of_layers(graph, layers, config, columns)
    return {"descriptor": graph.Where(too_large, np.nan, descriptor), "unknown": unknown}


def harmonics_of_layers(
    graph: Graph, layers: Layers, config: SSRVLADConfig, columns: Sequence[int]
) -> Symbol:
    """The coefficients of the soft histograms around the anchor, or around those of a sweep."""
    with graph.stage("boundaries"):
        edges = boundaries_in_graph(graph, layers.number)
    with graph.stage("vanishing_column"):
        column = graph.full([graph.sizes(layers.number, 4)[0]], 0, "float32")
        if config.anchor == "vanishing-column":
            column = vanishing_columns_in_graph(graph, layers.is_open)
    masks = graph.Concat(layers.masks, edges, axis=1)
    if not columns:
        return _around(graph, config, masks, column)
    seen = [_around(graph, config, masks, column + shift) for shift in columns]
    return graph.Concat(*(graph.Unsqueeze(each, [1]) for each in seen), axis=1)


def _layers(graph: Graph, labels: Symbol, config: SSRVLADConfig) -> _Seen:
    _, height, width = graph.sizes(labels, 3)
    table, origin = category_table(label_space(config.labels_as))
    entries, own_table = entries_in_graph(graph, labels, table, origin)
    grid = height, width
    if config.working_size is not None:
        grid = working_grid(graph, config.working_size, height, width)
    rows, columns = side_of(graph, height, grid[0], RADIX - 1), side_of(graph, width, grid[1])
    votes = votes_in_graph(graph, entries, own_table, rows, columns)
    found, unknown = (
        graph.Slice(votes, [first], [end], [1])
        for first, end in ((0, NO_LAYER + 1), (NO_LAYER + 1, KINDS))
    )
    too_large = (columns.length > WIDEST_CELL) | (grid[1] > WIDEST)
    layers = layers_in_graph(graph, found, rows, columns)
    return _Seen(layers, graph.ReduceSum(unknown, [1, 2], keepdims=0), too_large)


def _around(graph: Graph, config: SSRVLADConfig, masks: Symbol, column: Symbol) -> Symbol:
    """The coefficients of the soft histograms around one anchor."""
    _, _, height, width = graph.sizes(masks, 4)
    with graph.stage("grid_pooling"):
        sums = pool_in_graph(graph, masks, column).reshape(0, 0, -1)
    with graph.stage("harmonics"):
        tables, numbers = harmonic_tables(config), (config.harmonics, config.boundary_harmonics)
        area, side = height * width, graph.Min(height, width)
        found = harmonics_in_graph(graph, sums, area, tables)
        found = found * _scales(graph, area.to("float32"), side.to("float32"))
        return coefficients_in_graph(graph, found, numbers, config.power)


def _scales(graph: Graph, area: Symbol, side: Symbol) -> Symbol:
    """``(1, 10, 1)``, the square roots of what makes fractions of whole numbers of pixels, and
    lengths in sides of a cell of those of boundaries."""
    is_length = np.arange(AREA_LAYERS + BOUNDARY_DIRECTIONS) >= AREA_LAYERS
    per_side = graph.constant((is_length / (ROWS * WIDTH)).astype(np.float32))
    without = graph.constant((~is_length).astype(np.float32))
    return graph.Sqrt((per_side * side + without) / area).reshape(1, -1, 1)
