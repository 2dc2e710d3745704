"""Grid pooling as arithmetic."""

from __future__ import annotations

import numpy as np

from ...stages.grid_pooling import COLUMNS, ROWS
from ..graph import Graph, Symbol


def pool_in_graph(graph: Graph, layers: Symbol, shift: Symbol) -> Symbol:
    """`pool` in a graph, times ``h * w``, which makes whole numbers.

    Args:
        graph: the graph to add nodes to.
        layers: ``(B, n, h, w)`` float32, 0 or 1; at most 2 ** 24 pixels.
        shift: ``(B,)`` float32, columns.

    Returns:
        ``(B, n, 24, 32)`` float32.
    """
    _, _, height, width = graph.sizes(layers, 4)
    across = _overlaps(graph, width, COLUMNS, shift.reshape(-1, 1, 1, 1))
    upright = _overlaps(graph, height, ROWS)
    by_column = graph.MatMul(layers, across)
    return graph.MatMul(graph.Transpose(upright, perm=[1, 0]), by_column)


def _overlaps(graph: Graph, pixels: Symbol, cells: int, shift: Symbol | int = 0) -> Symbol:
    """``(..., pixels, cells)`` float32, the overlap of each pixel with each cell."""
    pixel = (graph.arange(pixels).to("float32").reshape(-1, 1) - shift) * cells
    cell = graph.constant(np.arange(cells, dtype=np.float32)) * pixels.to("float32")
    overlap = graph.Min(pixel + cells, cell + pixels.to("float32")) - graph.Max(pixel, cell)
    return graph.Relu(overlap)
