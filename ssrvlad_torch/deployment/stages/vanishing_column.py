"""Vanishing column as ONNX operators."""

from __future__ import annotations

import numpy as np

from ...stages.vanishing_column import LEVELS, ONE, OPEN_LAYERS, POWER, PULL, SHIFT
from ..graph import Graph, Symbol
from ..words import Words, planes_of
from .centroid import rounded_mean

WIDEST = 960
"""Columns of the widest grid whose sums of weights stay below 2 ** 31."""


def vanishing_columns_in_graph(graph: Graph, words: Words) -> Symbol:
    """`vanishing_columns` in a graph."""
    grid = words.grid
    is_open = (planes_of(graph, words) & OPEN_LAYERS).to("bool").to("float32")
    open_pixels = graph.ReduceSum(is_open, [1], keepdims=0).to("int32")
    weights = np.arange(LEVELS + 1, dtype=np.int64) ** POWER >> SHIFT
    level = (open_pixels * LEVELS // grid.height).reshape(-1)
    weight = graph.constant(weights.astype(np.int32)).take(level).reshape(-1, grid.width)
    twice_from_middle = graph.arange(grid.width) * 2 - (grid.width - 1)
    total = _by_image(graph, weight) + _pull(grid.width)
    products = weight.to("float32") * twice_from_middle.to("float32")
    about = graph.ReduceSum(products, [1], keepdims=0)
    moment = _by_image(graph, weight * twice_from_middle)
    return rounded_mean(graph, moment, about, total)


def _pull(width: Symbol) -> Symbol:
    """``width * ONE // PULL`` by a quotient of small numbers, which is exact in float32."""
    whole, rest = divmod(ONE, PULL)
    return width * whole + width * rest // PULL


def _by_image(graph: Graph, amounts: Symbol) -> Symbol:
    """``(B,)``, the sums of ``(B, n)``, which may wrap around."""
    (images,) = graph.sizes(amounts, 1)
    image = graph.Expand(graph.arange(images).reshape(-1, 1), graph.Shape(amounts))
    return graph.sums(image.reshape(-1), amounts.reshape(-1), images)
