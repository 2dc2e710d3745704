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
        return rounded_mean(graph, sums, estimates, area)

    return GraphPoints(present, mean(grid.row(segments.first) * 2), mean(first * 2 + length - 1))


def rounded_mean(graph: Graph, twice: Symbol, estimate: Symbol, area: Symbol) -> Symbol:
    """A sum divided by an area, rounded to the nearest, halves up.

    The int32 sum may have overflowed. The mean is guessed from the float32 sum. The remainder of
    the division is small, so it is exact in spite of the overflow, and corrects a guess that is off
    by one.

    Args:
        graph: the graph to add nodes to.
        twice: ``(n,)`` int32, twice the sum, modulo 2 ** 32.
        estimate: ``(n,)`` float32, twice the sum, rounded.
        area: ``(n,)`` int32, above 0.
    """
    guess = graph.Floor((estimate / area.to("float32") + 1) / 2).to("int32")
    remainder = twice + area - guess * area * 2
    return guess + (remainder - area * 2 >= 0).to("int32") - (remainder < 0).to("int32")
