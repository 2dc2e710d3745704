"""The head as arithmetic: `SSRVLAD.forward` for the aggregation harmonics."""

from __future__ import annotations

from collections.abc import Sequence

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
from .reduction import KINDS, MAX_CELL_WIDTH, RADIX, side_of, votes_in_graph
from .vanishing_column import MAX_WIDTH, vanishing_columns_in_graph


def describe_in_arithmetic(
    graph: Graph, labels: Symbol, config: SSRVLADConfig, columns: Sequence[int] = ()
) -> dict[str, Symbol]:
    """`SSRVLAD.forward` in a graph, or `SSRVLAD.sweep`, for the aggregation harmonics.

    Args:
        graph: the graph to add nodes to.
        labels: ``(B, H, W)`` uint8, int32 or int64 label ids; any axis can be dynamic.
        config: the settings.
        columns: S anchors of a sweep, for descriptors ``(B, S, 480)``; empty for single ones.

    Returns:
        ``descriptor (B, 480)`` float32, NaN where sums would not be exact: if the grid is wider
        than `MAX_WIDTH` or a cell wider than `MAX_CELL_WIDTH`; and ``unknown (B,)`` float32.
    """
    with graph.stage("layers"):
        layers, unknown, too_large = _layers(graph, labels, config)
    descriptor = harmonics_of_layers(graph, layers, config, columns)
    return {"descriptor": graph.Where(too_large, np.nan, descriptor), "unknown": unknown}


def harmonics_of_layers(
    graph: Graph, layers: Layers, config: SSRVLADConfig, columns: Sequence[int]
) -> Symbol:
    """The coefficients of the soft histograms around the anchor, or around the S of a sweep."""
    with graph.stage("boundaries"):
        edges = boundaries_in_graph(graph, layers.number)
    with graph.stage("vanishing_column"):
        column = graph.full([graph.sizes(layers.number, 4)[0]], 0, "float32")
        if config.anchor == "vanishing-column":
            column = vanishing_columns_in_graph(graph, layers.is_open)
    masks = graph.Concat(layers.masks, edges, axis=1)
    if not columns:
        return _around(graph, config, masks, column)
    swept = [_around(graph, config, masks, column + shift) for shift in columns]
    return graph.Concat(*(graph.Unsqueeze(each, [1]) for each in swept), axis=1)


def _layers(graph: Graph, labels: Symbol, config: SSRVLADConfig) -> tuple[Layers, Symbol, Symbol]:
    """The layers of a batch, ``(B,)`` counts of unknown ids, and ``()`` bool, whether the grid or a
    cell is too wide to be counted."""
    _, height, width = graph.sizes(labels, 3)
    table, origin = category_table(label_space(config.labels_as))
    entries, entry_table = entries_in_graph(graph, labels, table, origin)
    grid = height, width
    if config.working_size is not None:
        grid = working_grid(graph, config.working_size, height, width)
    rows, columns = side_of(graph, height, grid[0], RADIX - 1), side_of(graph, width, grid[1])
    votes = votes_in_graph(graph, entries, entry_table, rows, columns)
    known, unknown = (
        graph.Slice(votes, [first], [end], [1])
        for first, end in ((0, NO_LAYER + 1), (NO_LAYER + 1, KINDS))
    )
    too_large = (columns.length > MAX_CELL_WIDTH) | (grid[1] > MAX_WIDTH)
    layers = layers_in_graph(graph, known, rows, columns)
    return layers, graph.ReduceSum(unknown, [1, 2], keepdims=0), too_large


def _around(graph: Graph, config: SSRVLADConfig, masks: Symbol, column: Symbol) -> Symbol:
    """The coefficients of the soft histograms around one anchor."""
    _, _, height, width = graph.sizes(masks, 4)
    with graph.stage("grid_pooling"):
        sums = pool_in_graph(graph, masks, column).reshape(0, 0, -1)
    with graph.stage("harmonics"):
        tables, numbers = harmonic_tables(config), (config.harmonics, config.boundary_harmonics)
        area, side = height * width, graph.Min(height, width)
        products = harmonics_in_graph(graph, sums, area, tables)
        products = products * _scales(graph, area.to("float32"), side.to("float32"))
        return coefficients_in_graph(graph, products, numbers, config.power)


def _scales(graph: Graph, area: Symbol, side: Symbol) -> Symbol:
    """``(1, 10, 1)``, roots of factors that turn pixel counts of areas into fractions, and those
    of boundaries into lengths in sides of a cell."""
    is_length = np.arange(AREA_LAYERS + BOUNDARY_DIRECTIONS) >= AREA_LAYERS
    per_side = graph.constant((is_length / (ROWS * WIDTH)).astype(np.float32))
    is_area = graph.constant((~is_length).astype(np.float32))
    return graph.Sqrt((per_side * side + is_area) / area).reshape(1, -1, 1)
