"""Boundaries as arithmetic: the layers of a pixel's four diagonal neighbours form a number, with
which the directions of the boundaries at the pixel are looked up in a table."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ...stages.boundaries import directions
from ..graph import Graph, Symbol

_NUMBERS = AREA_LAYERS + 1
_CORNERS = [_NUMBERS**corner for corner in range(4)]
"""Factors of the layer numbers at NW, NE, SW and SE."""

_END = 1 << 30


def boundaries_in_graph(graph: Graph, number: Symbol) -> Symbol:
    """`boundaries` in a graph.

    Args:
        graph: the graph to add nodes to.
        number: ``(B, 1, h, w)`` float32 of `Layers`.

    Returns:
        ``(B, 4, h, w)`` float32, 0 or 1 for each direction.
    """
    _, _, height, width = graph.sizes(number, 4)
    padded = graph.Pad(number, [0, 0, 1, 1, 0, 0, 1, 1])
    (nw, ne), (sw, se) = (
        (graph.Slice(row, [0], [-2], [3]), graph.Slice(row, [2], [_END], [3]))
        for row in (graph.Slice(padded, [0], [-2], [2]), graph.Slice(padded, [2], [_END], [2]))
    )
    corners = nw + ne * _CORNERS[1] + sw * _CORNERS[2] + se * _CORNERS[3]
    interior = _interior(graph, height).reshape(-1, 1) * _interior(graph, width)
    table = _table()
    first = np.arange(BOUNDARY_DIRECTIONS, dtype=np.int32) * table.shape[1]
    index = (corners * interior).to("int32") + graph.constant(first[:, None, None])
    flags = graph.constant(table.ravel()).take(index.reshape(-1))
    return flags.reshape(-1, BOUNDARY_DIRECTIONS, height, width)


def _interior(graph: Graph, length: Symbol) -> Symbol:
    """``(length,)`` float32, 0 at both ends and 1 between. At the edge the number becomes 0, as if
    all neighbours were of layer 0, so pixels there have no boundary."""
    index = graph.arange(length)
    return ((index > 0) & (index < length - 1)).to("float32")


def _table() -> npt.NDArray[np.float32]:
    """``(4, 7 ** 4)`` float32, 1 if the boundary of any layer has the direction."""
    corners = np.arange(_NUMBERS**4) // np.array(_CORNERS)[:, None] % _NUMBERS
    planes = (1 << corners) & (1 << AREA_LAYERS) - 1
    return np.stack(directions(*planes)).astype(bool).astype(np.float32)
