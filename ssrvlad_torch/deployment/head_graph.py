"""The method as a graph: what `SSRVLAD.forward` does, stage by stage, in ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..config import AREA_LAYERS, BOUNDARY_DIRECTIONS, SSRVLADConfig
from ..stages.boundaries import WIDTH
from ..stages.grid_pooling import ROWS
from ..stages.harmonics import harmonic_tables
from ..stages.layers import category_table
from ..stages.skeleton import RULES
from ..taxonomy import label_space
from .geometry import Lengths, lengths, working_grid
from .graph import Graph, Symbol
from .stages.boundaries import boundaries_in_graph
from .stages.centroid import centroids_in_graph
from .stages.components import drop_regions_in_graph, fill_holes_in_graph
from .stages.grid_pooling import pool_in_graph
from .stages.harmonics import coefficients_in_graph, harmonics_in_graph
from .stages.keypoints import end_points_in_graph, intersections_in_graph
from .stages.layers import (
    categorise_in_graph,
    entries_in_graph,
    merge_in_graph,
    split_in_graph,
)
from .stages.morphology import open_and_close_in_graph
from .stages.reduction import reduce_by_majority_in_graph
from .stages.residuals import aggregate_in_graph
from .stages.shape_context import (
    log_polar_bins_in_graph,
    shape_contexts_in_graph,
    too_many_in_graph,
)
from .stages.skeleton import thin_in_graph
from .stages.vanishing_column import WIDEST, vanishing_columns_in_graph
from .words import Words, count_points_in_graph, grid_of, points_of


def describe_in_graph(
    graph: Graph, labels: Symbol, config: SSRVLADConfig, columns: Sequence[int] = ()
) -> dict[str, Symbol]:
    """`SSRVLAD.forward` in a graph, or `SSRVLAD.sweep`.

    Args:
        graph: where the nodes go.
        labels: ``(B, H, W)`` uint8 or int64 label ids, any of the sizes dynamic.
        config: the settings.
        columns: S anchors of a sweep, for descriptors ``(B, S, 480)``; none for single ones.

    Returns:
        ``descriptor (B, 480)`` float32, ``unknown (B,)`` int32, and of residuals ``keypoints
        (B, 8)`` int32.
    """
    with graph.stage("layers"):
        categories, unknown = _categories(graph, labels, config)
        grid = grid_of(*graph.sizes(categories, 3))
        layers = split_in_graph(graph, categories, grid)  # Table II
    if config.aggregation == "residuals":
        descriptor, counts = _residuals(graph, config, layers)
        return {"descriptor": descriptor, "unknown": unknown, "keypoints": counts}
    descriptor = _harmonics(graph, config, layers, columns)
    return {"descriptor": descriptor, "unknown": unknown}


def _residuals(graph: Graph, config: SSRVLADConfig, layers: Words) -> tuple[Symbol, Symbol]:
    """The paper's descriptor, and how many keypoints each layer has."""
    grid = layers.grid
    with graph.stage("geometry"):
        sizes = lengths(graph, config, grid)
    clean = _cleaned(graph, config, layers, sizes)
    with graph.stage("skeleton"):
        skeleton = thin_in_graph(graph, clean, RULES[config.thinning], not config.working_size)
    with graph.stage("keypoints"):
        ends = end_points_in_graph(graph, skeleton)
        crossings = intersections_in_graph(graph, skeleton)
        keypoints = points_of(graph, skeleton.with_line(ends.line | crossings.line))
        counts = count_points_in_graph(graph, keypoints, grid.images)
    with graph.stage("centroid"):
        centres = centroids_in_graph(graph, clean)  # Eq. 1
    with graph.stage("shape_context"):
        context = points_of(graph, skeleton) if config.context == "skeleton" else keypoints
        bins = log_polar_bins_in_graph(graph, grid, sizes.ring_limits, config.rings, config.sectors)
        point_sums = shape_contexts_in_graph(graph, keypoints, context, bins, grid.images)
        centre_counts = shape_contexts_in_graph(graph, centres, context, bins, grid.images)
    with graph.stage("aggregation"):
        descriptor = aggregate_in_graph(graph, point_sums, centre_counts, counts)  # Eq. 2
        too_many = too_many_in_graph(graph, keypoints, context, grid.images)
        return graph.Where(too_many, np.nan, descriptor), counts


def _cleaned(graph: Graph, config: SSRVLADConfig, layers: Words, sizes: Lengths) -> Words:
    """The layers after morphology, without small holes and regions."""
    with graph.stage("morphology"):
        clean = open_and_close_in_graph(graph, layers, sizes.opening, sizes.closing)
    with graph.stage("holes"):
        if config.hole_area:
            clean = fill_holes_in_graph(graph, clean, sizes.hole_area)
    with graph.stage("regions"):
        if config.region_area:
            clean = drop_regions_in_graph(graph, clean, sizes.region_area)
    return clean


def _harmonics(
    graph: Graph, config: SSRVLADConfig, layers: Words, columns: Sequence[int]
) -> Symbol:
    """The coefficients of the soft histograms around the anchor, or around those of a sweep."""
    grid = layers.grid
    with graph.stage("layers"):
        layers = merge_in_graph(layers)
    with graph.stage("boundaries"):
        edges = boundaries_in_graph(graph, layers)
    with graph.stage("vanishing_column"):
        column = graph.full([grid.images], 0, "int32")
        if config.anchor == "vanishing-column":
            column = vanishing_columns_in_graph(graph, layers)
    if not columns:
        return _around(graph, config, layers, edges, column)
    seen = [_around(graph, config, layers, edges, column + shift) for shift in columns]
    return graph.Concat(*(graph.Unsqueeze(each, [1]) for each in seen), axis=1)


def _around(
    graph: Graph, config: SSRVLADConfig, layers: Words, edges: Words, column: Symbol
) -> Symbol:
    """The coefficients of the soft histograms around one anchor."""
    grid = layers.grid
    with graph.stage("grid_pooling"):
        area = graph.Slice(pool_in_graph(graph, layers, column), [0], [AREA_LAYERS], [1])
        pooled = pool_in_graph(graph, edges, column)
        length = graph.Slice(pooled, [0], [BOUNDARY_DIRECTIONS], [1])
        sums = graph.Concat(area, length, axis=1).reshape(0, 0, -1)
    with graph.stage("harmonics"):
        tables, numbers = harmonic_tables(config), (config.harmonics, config.boundary_harmonics)
        whole = grid.height * grid.width
        found = harmonics_in_graph(graph, sums, whole, tables)
        side = graph.Min(grid.height, grid.width)
        found = found * _scales(graph, whole.to("float32"), side.to("float32"))
        descriptor = coefficients_in_graph(graph, found, numbers, config.power)
        return graph.Where(grid.width > WIDEST, np.nan, descriptor)


def _scales(graph: Graph, area: Symbol, side: Symbol) -> Symbol:
    """``(1, 10, 1)``, the square roots of what makes fractions of whole numbers of pixels, and
    lengths in sides of a cell of those of boundaries."""
    is_length = np.arange(AREA_LAYERS + BOUNDARY_DIRECTIONS) >= AREA_LAYERS
    per_side = graph.constant((is_length / (ROWS * WIDTH)).astype(np.float32))
    without = graph.constant((~is_length).astype(np.float32))
    return graph.Sqrt((per_side * side + without) / area).reshape(1, -1, 1)


def _categories(graph: Graph, labels: Symbol, config: SSRVLADConfig) -> tuple[Symbol, Symbol]:
    """``(B, h, w)`` uint8 categories on the working grid and ``(B,)`` int32 unknown ids."""
    entries, table = entries_in_graph(graph, labels, *category_table(label_space(config.labels_as)))
    if config.working_size is None:
        return categorise_in_graph(graph, entries, table)
    _, height, width = graph.sizes(labels, 3)
    grid = working_grid(graph, config.working_size, height, width)
    return reduce_by_majority_in_graph(graph, entries, table, (height, width), grid)
