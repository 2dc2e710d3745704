"""Layers as ONNX operators."""

from __future__ import annotations

import numpy as np

from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol
from ..words import PIXELS, Grid, Words


def split_in_graph(graph: Graph, categories: Symbol, grid: Grid) -> Words:
    """`split` in a graph: the bits of three pixels of a row form a word.

    Args:
        graph: the graph to add nodes to.
        categories: ``(B, H, W)`` uint8: 0 to 7 or `NO_LAYER`.
        grid: the grid of B, H and W.
    """
    kinds = NO_LAYER + 1
    right = grid.pitch * PIXELS - grid.width
    padded = graph.Pad(categories, graph.vector(0, 0, 0, 0, 1, right), NO_LAYER)
    bits = np.zeros((PIXELS, kinds), np.int32)
    for pixel, kind in np.ndindex(PIXELS, NO_LAYER):
        bits[pixel, kind] = 1 << 8 * pixel + kind
    by_pixel = graph.Transpose(padded.reshape(-1, PIXELS), perm=[1, 0])
    first = graph.constant(np.arange(PIXELS, dtype=np.int32)[:, None] * kinds)
    words = graph.constant(bits.ravel()).take((by_pixel.to("int32") + first).reshape(-1))
    first, second, third = graph.split(words, PIXELS)
    return Words(first + second + third, grid)
