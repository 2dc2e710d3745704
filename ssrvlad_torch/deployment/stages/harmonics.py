"""Harmonics as ONNX operators."""

from __future__ import annotations

from torch import Tensor

from ..graph import Graph, Symbol


def soft_histograms_in_graph(
    graph: Graph, area: Symbol, skeleton: Symbol, skeleton_weight: float, bins: Tensor
) -> Symbol:
    """`soft_histograms` in a graph."""
    table = graph.sparse_constant(bins.T.numpy())
    covered, lengths = (
        graph.Sqrt(graph.MatMul(cells.reshape(0, 0, -1), table)) for cells in (area, skeleton)
    )
    return covered + lengths * skeleton_weight


def coefficients_in_graph(graph: Graph, histogram: Symbol, basis: Tensor, power: float) -> Symbol:
    """`coefficients` in a graph."""
    held = graph.MatMul(histogram, graph.constant(basis.T.numpy().copy()))
    damped = graph.Sign(held) * graph.Pow(graph.Abs(held), power)
    return graph.normalised(graph.Flatten(damped)).to("float32")
