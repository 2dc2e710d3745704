"""Harmonics as ONNX operators."""

from __future__ import annotations

import numpy as np

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ...stages.harmonics import Tables
from ..double_float import DoubleFloat, product, root, weighted_means
from ..graph import Graph, Symbol


def harmonics_in_graph(graph: Graph, sums: Symbol, largest: Symbol, tables: Tables) -> Symbol:
    """`soft_histograms` and the products of `coefficients` in a graph, but for the scale of the
    cells, which the root and the products let through.

    Args:
        graph: where the nodes go.
        sums: ``(B, 10, cells)`` float32, the cells as whole numbers.
        largest: ``()`` int32, the largest that a cell can be.
        tables: of `harmonic_tables`.

    Returns:
        ``(B, 10, harmonics)`` float32.
    """
    bins, basis = (table.T.numpy() for table in tables)
    powers = graph.constant(4 ** np.arange(13, dtype=np.int32))
    place = graph.ReduceSum((powers < largest).to("int32"), [0])
    shrink = graph.constant(0.25 ** np.arange(14, dtype=np.float32)).take(place)
    means = weighted_means(graph, sums, bins)
    roots = root(graph, DoubleFloat(means.high * shrink, means.low * shrink))
    return product(graph, roots, basis) / graph.Sqrt(shrink)


def coefficients_in_graph(
    graph: Graph, found: Symbol, numbers: tuple[int, int], power: float
) -> Symbol:
    """`coefficients` in a graph, but for the products."""
    area = graph.Slice(found, [0, 0], [AREA_LAYERS, numbers[0]], [1, 2])
    blocks = AREA_LAYERS + BOUNDARY_DIRECTIONS
    length = graph.Slice(found, [AREA_LAYERS, 0], [blocks, numbers[1]], [1, 2])
    kept = graph.Concat(graph.Flatten(area), graph.Flatten(length), axis=1)
    return graph.normalised(graph.Sign(kept) * graph.Pow(graph.Abs(kept), power)).to("float32")
