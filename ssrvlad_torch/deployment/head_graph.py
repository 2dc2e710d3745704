"""The method as a graph: the stages of `SSRVLAD.forward` in ONNX operators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..config import SSRVLADConfig
from ..stages.layers import category_table
from ..stages.skeleton import RULES
from ..taxonomy import label_space
from .arithmetic.head import harmonics_of_layers
from .arithmetic.layers import layers_of_categories
from .arithmetic.vanishing_column import MAX_WIDTH
from .geometry import Lengths, lengths, working_grid
from .graph import Graph, Symbol
from .stages.centroid import centroids_in_graph
from .stages.components import drop_regions_in_graph, fill_holes_in_graph
from .stages.keypoints import end_points_in_graph, intersections_in_graph
from .stages.layers import categorise_in_graph, entries_in_graph, split_in_graph
from .stages.morphology import open_and_close_in_graph
from .stages.reduction import reduce_by_majority_in_graph
from .stages.residuals import aggregate_in_graph
from .stages.shape_context import (
    log_polar_bins_in_graph,
    shape_contexts_in_graph,
    too_many_in_graph,
)
from .stages.skeleton import thin_in_graph
from .words import Words, count_points_in_graph, grid_of, points_of


def describe_in_graph(
    graph: Graph, labels: Symbol, config: SSRVLADConfig, columns: Sequence[int] = ()
) -> dict[str, Symbol]:
    """`SSRVLAD.forward` in a graph, or `SSRVLAD.sweep`.

    Args:
        graph: the graph to add nodes to.
        labels: ``(B, H, W)`` uint8 or int64 label ids; any axis can be dynamic.
        config: the settings.
        columns: S anchors of a sweep, for descriptors ``(B, S, 480)``; empty for single ones.

    Returns:
        ``descriptor (B, 480)`` float32, ``unknown (B,)`` int32, and for the aggregation residuals
        ``keypoints (B, 8)`` int32.
    """
    with graph.stage("layers"):
        categories, unknown = _categories(graph, labels, config)
    if config.aggregation == "residuals":
        descriptor, counts = _residuals(graph, config, categories)
        return {"descriptor": descriptor, "unknown": unknown, "keypoints": counts}
    with graph.stage("layers"):
        layers = layers_of_categories(graph, categories)  # Table II
    descriptor = harmonics_of_layers(graph, layers, config, columns)
    is_wide = graph.sizes(categories, 3)[2] > MAX_WIDTH
    return {"descriptor": graph.Where(is_wide, np.nan, descriptor), "unknown": unknown}


def _residuals(graph: Graph, config: SSRVLADConfig, categories: Symbol) -> tuple[Symbol, Symbol]:
    """The paper's descriptor, and the number of keypoints of each layer."""
    grid = grid_of(*graph.sizes(categories, 3))
    with graph.stage("layers"):
        layers = split_in_graph(graph, categories, grid)  # Table II
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
    """The layers after morphology, with small holes filled and small regions dropped."""
    with graph.stage("morphology"):
        clean = open_and_close_in_graph(graph, layers, sizes.opening, sizes.closing)
    with graph.stage("holes"):
        if config.hole_area:
            clean = fill_holes_in_graph(graph, clean, sizes.hole_area)
    with graph.stage("regions"):
        if config.region_area:
            clean = drop_regions_in_graph(graph, clean, sizes.region_area)
    return clean


def _categories(graph: Graph, labels: Symbol, config: SSRVLADConfig) -> tuple[Symbol, Symbol]:
    """``(B, h, w)`` uint8 categories on the working grid; ``(B,)`` int32 counts of unknown ids."""
    entries, table = entries_in_graph(graph, labels, *category_table(label_space(config.labels_as)))
    if config.working_size is None:
        return categorise_in_graph(graph, entries, table)
    _, height, width = graph.sizes(labels, 3)
    grid = working_grid(graph, config.working_size, height, width)
    return reduce_by_majority_in_graph(graph, entries, table, (height, width), grid)
