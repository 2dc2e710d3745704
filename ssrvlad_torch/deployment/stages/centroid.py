"""Centroid as ONNX operators."""

from __future__ import annotations

from ...bitplanes import LAYERS
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
    present = graph.places(area)
    area = area.take(present)

    def mean(twice: Symbol) -> Symbol:
        """Sums of ``length * twice / 2`` over the area, rounded to the nearest, halves up."""
        weighted = length * twice
        sums, about = (
            graph.sums(group, amounts, groups).take(present)
            for amounts in (weighted, weighted.to("float32"))
        )
        return rounded_mean(graph, sums, about, area)

    return GraphPoints(present, mean(grid.row(segments.first) * 2), mean(first * 2 + length - 1))


def rounded_mean(graph: Graph, twice: Symbol, about: Symbol, area: Symbol) -> Symbol:
    """Half of a sum over an area, rounded to the nearest, halves up.

    The sum may have wrapped around: what it leaves of the area times a mean that is nearly right
    is small and tells whether the mean is one too small or too large.

    Args:
        graph: where the nodes go.
        twice: ``(n,)`` int32, twice the sum.
        about: ``(n,)`` float32, the same, not exact and not wrapped around.
        area: ``(n,)`` int32, above 0.
    """
    guess = graph.Floor((about / area.to("float32") + 1) / 2).to("int32")
    left = twice + area - guess * area * 2
    return guess + (left - area * 2 >= 0).to("int32") - (left < 0).to("int32")
