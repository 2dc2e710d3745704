"""Centroid as ONNX operators."""

from __future__ import annotations

from ...bitplanes import LAYERS
from ..graph import Graph
from ..words import GraphPoints, Words, runs_of


def centroids_in_graph(graph: Graph, words: Words) -> GraphPoints:
    """`centroids` in a graph."""
    grid = words.grid
    segments = runs_of(graph, words.line)
    group = segments.layer * grid.images + grid.image(segments.first)
    first, length = grid.column(segments.first), segments.length
    weighted = (length, grid.row(segments.first) * length, (first * 2 + length - 1) * length // 2)
    area, sum_y, sum_x = (graph.sums(group, amounts, grid.images * LAYERS) for amounts in weighted)
    group = graph.NonZero(area).reshape(-1)
    area, sum_y, sum_x = (sums.take(group) for sums in (area, sum_y, sum_x))
    return GraphPoints(group, (sum_y * 2 + area) // (area * 2), (sum_x * 2 + area) // (area * 2))
