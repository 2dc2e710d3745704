"""Vanishing column as ONNX operators."""

from __future__ import annotations

from ...stages.vanishing_column import LEVELS, ONE, OPEN_LAYERS, POWER, PULL, SHIFT
from ..graph import Graph, Symbol
from ..words import Words, planes_of


def vanishing_columns_in_graph(graph: Graph, words: Words) -> Symbol:
    """`vanishing_columns` in a graph."""
    width = words.grid.width
    is_open = (planes_of(graph, words) & OPEN_LAYERS).to("bool").to("float32")
    open_pixels = graph.ReduceSum(is_open, [1], keepdims=0).to("int64")
    weight = open_pixels * LEVELS // words.grid.height
    for _ in range(POWER.bit_length() - 1):
        weight = weight * weight
    weight = weight // (1 << SHIFT)
    twice_from_middle = graph.arange(width) * 2 - (width - 1)
    moment = graph.ReduceSum(weight * twice_from_middle, [1], keepdims=0)
    total = graph.ReduceSum(weight, [1], keepdims=0) + width * ONE // PULL
    twice_from_left = moment + total * width * 2  # nothing negative is divided
    return (twice_from_left + total) // (total * 2) - width
