"""The method as a graph: what `SSRVLAD.forward` does, stage by stage, in ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..config import AREA_LAYERS, BOUNDARY_DIRECTIONS, SSRVLADConfig
from ..stages.boundaries import WIDTH
from ..stages.grid_pooling import ROWS
from ..stages.harmonics import harmonic_tables
from ..stages.layers import category_table
from ..stages.skeleton import RULES
from ..taxonomy import label_space
from .geometry import area_pixels, radius_pixels, ring_limits, working_grid
from .graph import Graph, Symbol
from .stages.boundaries import boundaries_in_graph
from .stages.centroid import centroids_in_graph
from .stages.components import drop_regions_in_graph, fill_holes_in_graph
from .stages.grid_pooling import pool_in_graph
from .stages.harmonics import (
    coefficients_in_graph,
    soft_histograms_in_graph,
)
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
from .stages.shape_context import log_polar_bins_in_graph, shape_contexts_in_graph
from .stages.skeleton import thin_in_graph
from .stages.vanishing_column import vanishing_columns_in_graph
from .words import GraphPoints, Words, count_points_in_graph, grid_of, points_of


class Described(NamedTuple):
    """What the graph gives for a batch: ``(B, 480)`` float32, ``(B, 8)`` int64, ``(B,)`` int64."""

    descriptor: Symbol
    keypoints: Symbol
    unknown: Symbol


def describe_in_graph(
    graph: Graph, labels: Symbol, config: SSRVLADConfig, columns: Sequence[int] = ()
) -> Described:
    """`SSRVLAD.forward` in a graph, or `SSRVLAD.sweep`.

    Args:
        graph: where the nodes go.
        labels: ``(B, H, W)`` uint8 or int64 label ids, any of the sizes dynamic.
        config: the settings.
        columns: S anchors of a sweep, for descriptors ``(B, S, 480)``; none for single ones.
    """
    with graph.stage("layers"):
        categories, unknown = _categories(graph, labels, config)
        images, height, width = (graph.Shape(categories)[axis] for axis in range(3))
        grid = grid_of(images, height, width)
        layers = split_in_graph(graph, categories, grid)  # Table II
    clean = _cleaned(graph, config, layers)
    with graph.stage("skeleton"):
        skeleton = thin_in_graph(graph, clean, RULES[config.thinning])
    with graph.stage("keypoints"):
        ends = end_points_in_graph(graph, skeleton)
        crossings = intersections_in_graph(graph, skeleton)
        keypoints = points_of(graph, skeleton.with_line(ends.line | crossings.line))
        counts = count_points_in_graph(graph, keypoints, images)
    if config.aggregation == "residuals":
        descriptor = _residuals(graph, config, clean, skeleton, keypoints, counts)
    else:
        descriptor = _harmonics(graph, config, merge_in_graph(layers), columns)
    return Described(descriptor, counts, unknown)


def _cleaned(graph: Graph, config: SSRVLADConfig, layers: Words) -> Words:
    """The layers after morphology, without small holes and regions."""
    grid = layers.grid
    with graph.stage("morphology"):
        opening = radius_pixels(graph, config, config.opening, grid)
        closing = radius_pixels(graph, config, config.closing, grid)
        clean = open_and_close_in_graph(graph, layers, opening, closing)
    with graph.stage("holes"):
        if config.hole_area:
            clean = fill_holes_in_graph(graph, clean, area_pixels(config, config.hole_area, grid))
    with graph.stage("regions"):
        if config.region_area:
            area = area_pixels(config, config.region_area, grid)
            clean = drop_regions_in_graph(graph, clean, area)
    return clean


def _residuals(
    graph: Graph,
    config: SSRVLADConfig,
    clean: Words,
    skeleton: Words,
    keypoints: GraphPoints,
    counts: Symbol,
) -> Symbol:
    """The paper's descriptor."""
    grid = clean.grid
    with graph.stage("centroid"):
        centres = centroids_in_graph(graph, clean)  # Eq. 1
    with graph.stage("shape_context"):
        context = points_of(graph, skeleton) if config.context == "skeleton" else keypoints
        limits = ring_limits(config, grid)
        bins = log_polar_bins_in_graph(graph, grid.height, grid.width, limits, config.sectors)
        point_sums = shape_contexts_in_graph(graph, keypoints, context, bins, grid.images)
        centre_counts = shape_contexts_in_graph(graph, centres, context, bins, grid.images)
    with graph.stage("aggregation"):
        return aggregate_in_graph(graph, point_sums, centre_counts, counts)  # Eq. 2


def _harmonics(
    graph: Graph, config: SSRVLADConfig, layers: Words, columns: Sequence[int]
) -> Symbol:
    """The coefficients of the soft histograms around the anchor, or around those of a sweep."""
    grid = layers.grid
    with graph.stage("boundaries"):
        edges = boundaries_in_graph(graph, layers)
    with graph.stage("vanishing_column"):
        column = graph.full([grid.images], 0, "int64")
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
        unit = graph.Min(grid.height, grid.width).to("float64") / (ROWS * WIDTH)
        area = graph.Slice(pool_in_graph(graph, layers, column), [0], [AREA_LAYERS], [1])
        pooled = pool_in_graph(graph, edges, column)
        lengths = graph.Slice(pooled, [0], [BOUNDARY_DIRECTIONS], [1]) * unit
        cells = graph.Concat(area, lengths, axis=1)
    with graph.stage("harmonics"):
        tables, numbers = harmonic_tables(config), (config.harmonics, config.boundary_harmonics)
        histogram = soft_histograms_in_graph(graph, cells, tables.bins)
        return coefficients_in_graph(graph, histogram, tables.basis, numbers, config.power)


def _categories(graph: Graph, labels: Symbol, config: SSRVLADConfig) -> tuple[Symbol, Symbol]:
    """``(B, h, w)`` uint8 categories on the working grid and ``(B,)`` int64 unknown ids, an image
    at a time so that memory stays bounded."""
    table, origin = category_table(label_space(config.labels_as))
    images, height, width = (graph.Shape(labels)[axis] for axis in range(3))

    def one_image(step: Symbol) -> tuple[Symbol, Symbol]:
        entries, own_table = entries_in_graph(graph, labels[step], table, origin)
        if config.working_size is None:
            return categorise_in_graph(graph, entries, own_table, (height, width))
        grid = working_grid(graph, config.working_size, height, width)
        return reduce_by_majority_in_graph(graph, entries, own_table, (height, width), grid)

    categories, unknown = graph.stacked(images, one_image, 2)
    return categories, unknown
