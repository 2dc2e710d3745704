"""Harmonics as ONNX operators."""

from __future__ import annotations

from torch import Tensor

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ..graph import Graph, Symbol


def soft_histograms_in_graph(graph: Graph, cells: Symbol, bins: Tensor) -> Symbol:
    """`soft_histograms` in a graph."""
    table = graph.sparse_constant(bins.T.numpy())
    return graph.Sqrt(graph.MatMul(cells.reshape(0, 0, -1), table))


def coefficients_in_graph(
    graph: Graph, histogram: Symbol, basis: Tensor, numbers: tuple[int, int], power: float
) -> Symbol:
    """`coefficients` in a graph."""
    found = graph.MatMul(histogram, graph.constant(basis.T.numpy().copy()))
    area = graph.Slice(found, [0, 0], [AREA_LAYERS, numbers[0]], [1, 2])
    blocks = AREA_LAYERS + BOUNDARY_DIRECTIONS
    length = graph.Slice(found, [AREA_LAYERS, 0], [blocks, numbers[1]], [1, 2])
    kept = graph.Concat(graph.Flatten(area), graph.Flatten(length), axis=1)
    return graph.normalised(graph.Sign(kept) * graph.Pow(graph.Abs(kept), power)).to("float32")
