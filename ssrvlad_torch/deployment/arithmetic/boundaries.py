"""Boundaries as arithmetic: the layers of the diagonal neighbours of a pixel make a number, and a
table says what runs past the pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...config import AREA_LAYERS, BOUNDARY_DIRECTIONS
from ...stages.boundaries import directions
from ..graph import Graph, Symbol

_NUMBERS = AREA_LAYERS + 1
_CORNERS = [_NUMBERS**corner for corner in range(4)]
"""What the number of the layer at NW, NE, SW and SE is multiplied with."""

_END = 1 << 30


def boundaries_in_graph(graph: Graph, number: Symbol) -> Symbol:
    """`boundaries` in a graph.

    Args:
        graph: where the nodes go.
        number: ``(B, 1, h, w)`` float32 of `Layers`.

    Returns:
        ``(B, 4, h, w)`` float32, 0 or 1, a direction after the other.
    """
    _, _, height, width = graph.sizes(number, 4)
    padded = graph.Pad(number, [0, 0, 1, 1, 0, 0, 1, 1])
    (nw, ne), (sw, se) = (
        (graph.Slice(row, [0], [-2], [3]), graph.Slice(row, [2], [_END], [3]))
        for row in (graph.Slice(padded, [0], [-2], [2]), graph.Slice(padded, [2], [_END], [2]))
    )
    corners = nw + ne * _CORNERS[1] + sw * _CORNERS[2] + se * _CORNERS[3]
    within = _within(graph, height).reshape(-1, 1) * _within(graph, width)
    table = _table()
    first = np.arange(BOUNDARY_DIRECTIONS, dtype=np.int32) * table.shape[1]
    place = (corners * within).to("int32") + graph.constant(first[:, None, None])
    found = graph.constant(table.ravel()).take(place.reshape(-1))
    return found.reshape(-1, BOUNDARY_DIRECTIONS, height, width)


def _within(graph: Graph, length: Symbol) -> Symbol:
    """``(length,)`` float32, 0 at both ends and 1 between: pixels at the edge have no boundary, as
    those have none whose neighbours are all of layer 0."""
    place = graph.arange(length)
    return ((place > 0) & (place < length - 1)).to("float32")


def _table() -> npt.NDArray[np.float32]:
    """``(4, 7 ** 4)`` float32, whether a boundary of any layer has a direction."""
    corners = np.arange(_NUMBERS**4) // np.array(_CORNERS)[:, None] % _NUMBERS
    planes = (1 << corners) & (1 << AREA_LAYERS) - 1
    return np.stack(directions(*planes)).astype(bool).astype(np.float32)
