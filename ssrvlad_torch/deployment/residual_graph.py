"""The aggregation residuals as a graph: loops over frontiers and lists of pixels, which tracing
would make several times slower."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..config import CATEGORY_COUNT, SSRVLADConfig
from ..stages.skeleton import RULES
from .geometry import Lengths, lengths
from .graph import Form, Graph, Symbol
from .stages.centroid import centroids_in_graph
from .stages.components import drop_regions_in_graph, fill_holes_in_graph
from .stages.keypoints import end_points_in_graph, intersections_in_graph
from .stages.layers import split_in_graph
from .stages.morphology import open_and_close_in_graph
from .stages.residuals import aggregate_in_graph
from .stages.shape_context import (
    log_polar_bins_in_graph,
    shape_contexts_in_graph,
    too_many_in_graph,
)
from .stages.skeleton import thin_in_graph
from .words import Words, count_points_in_graph, grid_of, points_of

if TYPE_CHECKING:
    import onnx


def residual_graph(config: SSRVLADConfig) -> onnx.ModelProto:
    """A graph from ``layers (B, h, w)`` uint8, the layer of each pixel, to ``descriptor (B, D)``
    float32 and ``keypoints (B, 8)`` int64 of `Residuals`."""
    graph = Graph({"layers": ("uint8", ["B", "h", "w"])})
    descriptor, counts = _residuals(graph, config, *graph.inputs)
    outputs: dict[str, tuple[Symbol, Form]] = {
        "descriptor": (descriptor, ("float32", ["B", config.length])),
        "keypoints": (counts, ("int64", ["B", CATEGORY_COUNT])),
    }
    return graph.model(outputs)


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
