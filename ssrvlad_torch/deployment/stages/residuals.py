"""Residuals as ONNX operators."""

from __future__ import annotations

from ..graph import Graph, Symbol


def aggregate_in_graph(
    graph: Graph, point_sums: Symbol, centres: Symbol, point_counts: Symbol
) -> Symbol:
    """`aggregate` in a graph."""
    residuals = point_sums - point_counts.reshape(0, 0, 1) * centres  # Eq. 2, numerator
    layers = graph.normalised(residuals.to("float32"))  # Eq. 2; zeros stay zeros
    return graph.normalised(graph.Flatten(layers)).to("float32")
