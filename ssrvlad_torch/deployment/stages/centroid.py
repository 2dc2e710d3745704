"""Centroid as ONNX operators."""

from __future__ import annotations

from ...stages.bitplanes import LAYERS
from ..graph import Graph, Symbol
from ..words import GraphPoints, Words, runs_of


def centroids_in_graph(graph: Graph, words: Words) -> GraphPoints:
    """`centroids` in a graph."""
    grid = words.grid
    segments = runs_of(graph, words.line)
    group = segments.layer * grid.images + grid.image(segments.first)
    first, length = grid.column(segments.first), segments.length
    groups = grid.images * LAYERS
    area = graph.sums(group, length, groups)
    present = graph.indices(area)
    area = area.take(present)

    def mean(twice: Symbol) -> Symbol:
        """Sums of ``length * twice / 2`` over the area, rounded to the nearest, halves up."""
        weighted = length * twice
        sums, estimates = (
            graph.sums(group, amounts, groups).take(present)
            for amounts in (weighted, weighted.to("float32"))
        )
        middle = (estimates / area.to("float32") + 1) / 2
        return graph.divided(sums + area, middle, area * 2)[0]

    return GraphPoints(present, mean(grid.row(segments.first) * 2), mean(first * 2 + length - 1))
