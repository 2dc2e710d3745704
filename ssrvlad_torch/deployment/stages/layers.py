"""Layers as ONNX operators."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ...stages.layers import UNKNOWN
from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol
from ..words import PIXELS, Grid, Words


def entries_in_graph(
    graph: Graph, labels: Symbol, table: Tensor, origin: int
) -> tuple[Symbol, npt.NDArray[np.uint8]]:
    """The first half of `categorise` in a graph: the index of each pixel in the table.

    Args:
        graph: the graph to add nodes to.
        labels: label ids of any shape, uint8 or int64.
        table, origin: from `category_table`.

    Returns:
        uint8 or int32 of the same shape, the index of each pixel in the table, and the table for
        this dtype, ``(T,)`` uint8.
    """
    if labels.dtype == "uint8":
        return labels, table[origin : origin + 256].numpy()
    entries = graph.Min(graph.Max(labels, -origin), len(table) - 1 - origin) + origin
    return entries.to("int32"), table.numpy()


def categorise_in_graph(
    graph: Graph, entries: Symbol, table: npt.NDArray[np.uint8]
) -> tuple[Symbol, Symbol]:
    """The second half of `categorise` in a graph: the look-up.

    Args:
        graph: the graph to add nodes to.
        entries, table: from `entries_in_graph`, ``(B, H, W)``.

    Returns:
        ``(B, H, W)`` uint8, and ``(B,)`` int32, the number of unknown ids.
    """
    flat = graph.constant(table).take(entries.to("int32").reshape(-1))
    categories = graph.Reshape(flat, graph.Shape(entries))
    is_unknown = categories.to("int32").equals(UNKNOWN).to("float32")
    by_row = graph.ReduceSum(
        is_unknown, [2], keepdims=0
    )  # exact: a row has less than 2 ** 24 pixels
    return categories, graph.ReduceSum(by_row.to("int32"), [1], keepdims=0)


def split_in_graph(graph: Graph, categories: Symbol, grid: Grid) -> Words:
    """`split` in a graph: the bits of three pixels of a row form a word.

    Args:
        graph: the graph to add nodes to.
        categories: ``(B, H, W)`` uint8: 0 to 7, `NO_LAYER` or `UNKNOWN`.
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
    words = graph.constant(bits.ravel()).take(
        (graph.Min(by_pixel.to("int32"), NO_LAYER) + first).reshape(-1)
    )
    first, second, third = graph.split(words, PIXELS)
    return Words(first + second + third, grid)
