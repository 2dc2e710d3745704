"""Grid pooling as ONNX operators."""

from __future__ import annotations

import numpy as np

from ...bitplanes import LAYERS
from ...stages.grid_pooling import COLUMNS, ROWS
from ..graph import Graph, Symbol
from ..words import Words, planes_of


def pool_in_graph(graph: Graph, words: Words, shift: Symbol) -> Symbol:
    """`pool` in a graph, an image at a time, times H * W: whole numbers, float32."""
    planes, grid = planes_of(graph, words), words.grid
    bits = graph.constant((1 << np.arange(LAYERS)).astype(np.uint8)[:, None, None])
    upright = _overlaps_in_graph(graph, grid.height, ROWS, 0).to("float32")

    def one_image(step: Symbol) -> list[Symbol]:
        layers = (planes[step] & bits).to("bool").to("float32")
        across = _overlaps_in_graph(graph, grid.width, COLUMNS, shift[step])
        by_column = graph.MatMul(layers, graph.Transpose(across.to("float32"), perm=[1, 0]))
        return [graph.MatMul(upright, by_column)]

    return graph.stacked(grid.images, one_image)[0]


def _overlaps_in_graph(graph: Graph, pixels: Symbol, cells: int, shift: Symbol | int) -> Symbol:
    """``(cells, pixels)`` int32, `overlaps` for one shift."""
    pixel = (graph.arange(pixels) - shift) * cells
    cell = (graph.constant(np.arange(cells, dtype=np.int32)[:, None])) * pixels
    within = graph.Min(pixel + cells, cell + pixels) - graph.Max(pixel, cell)
    return graph.Max(within, 0)
