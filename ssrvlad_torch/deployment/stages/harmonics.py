"""Harmonics as ONNX operators."""

from __future__ import annotations

import numpy as np

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ...stages.harmonics import Tables
from ..double_float import DoubleFloat, product, root, weighted_means
from ..graph import Graph, Symbol


def harmonics_in_graph(graph: Graph, sums: Symbol, largest: Symbol, tables: Tables) -> Symbol:
    """`soft_histograms` and the products of `coefficients` in a graph, without the scale of the
    cells: it is a factor that the root and the products do not mix, and can be applied after them.

    Args:
        graph: the graph to add nodes to.
        sums: ``(B, 10, cells)`` float32, the cells as whole numbers.
        largest: ``()`` int32, an upper bound of a cell.
        tables: the tables of `harmonic_tables`.

    Returns:
        ``(B, 10, harmonics)`` float32.
    """
    bins, basis = (table.T.numpy() for table in tables)
    powers = graph.constant(4 ** np.arange(13, dtype=np.int32))
    exponent = graph.ReduceSum((powers < largest).to("int32"), [0])
    scale = graph.constant(0.25 ** np.arange(14, dtype=np.float32)).take(exponent)
    means = weighted_means(graph, sums, bins)
    roots = root(graph, DoubleFloat(means.high * scale, means.low * scale))
    return product(graph, roots, basis) / graph.Sqrt(scale)


def coefficients_in_graph(
    graph: Graph, products: Symbol, numbers: tuple[int, int], power: float
) -> Symbol:
    """`coefficients` in a graph, from the products of `harmonics_in_graph`."""
    blocks = AREA_LAYERS + BOUNDARY_DIRECTIONS
    areas = graph.Slice(products, [0, 0], [AREA_LAYERS, numbers[0]], [1, 2])
    boundaries = graph.Slice(products, [AREA_LAYERS, 0], [blocks, numbers[1]], [1, 2])
    both = graph.Concat(graph.Flatten(areas), graph.Flatten(boundaries), axis=1)
    return graph.normalised(graph.Sign(both) * graph.Pow(graph.Abs(both), power)).to("float32")
