"""Vanishing column as arithmetic.

Sums of weights have up to forty bits and are represented by digits. Instead of a division, they are
compared with their value at every column that could be the result.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...stages.vanishing_column import LEVELS, ONE, POWER, PULL, SHIFT
from ..graph import Graph, Symbol

RADIX = 8
DIGITS = 7
"""Digits of a weight, which is at most ``ONE``."""

MAX_WIDTH = 960
"""Columns of the widest grid. A digit of the sums is below ``14 * MAX_WIDTH ** 2``: digits of at
most 7 of all weights and of the middle, times twice the distance of two columns."""


def vanishing_columns_in_graph(graph: Graph, is_open: Symbol) -> Symbol:
    """`vanishing_columns` in a graph.

    Args:
        graph: the graph to add nodes to.
        is_open: ``(B, 1, h, w)`` float32 of `Layers`; w is at most `MAX_WIDTH`.

    Returns:
        ``(B,)`` float32.
    """
    _, _, height, width = graph.sizes(is_open, 4)
    open_pixels = graph.ReduceSum(is_open, [1, 2], keepdims=0)
    level = graph.Floor((open_pixels * LEVELS + 0.5) / height.to("float32"))
    weight = graph.Gather(graph.constant(_weights()), level.to("int32"), axis=0)
    twice_from_middle = (graph.arange(width) * 2 - (width - 1)).to("float32")
    moment = graph.ReduceSum(weight * twice_from_middle.reshape(-1, 1), [1])
    total = graph.ReduceSum(weight, [1]) + _pull(graph, width)

    reach = width // 2 + 1
    column = (graph.arange(reach * 2 + 1) - reach).to("float32").reshape(-1, 1)
    rest = moment + total - column * total * 2  # not negative up to the result
    carried, *higher = graph.split(rest, DIGITS, axis=2)
    for digit in higher:
        carried = digit + graph.Floor(carried * (1 / RADIX))
    count = graph.ReduceSum((carried >= 0).to("float32"), [1, 2], keepdims=0)
    return count - (reach + 1).to("float32")


def _weights() -> npt.NDArray[np.float32]:
    """``(65, 7)`` float32, the digits of the weight of each level, lowest first."""
    weights = np.arange(LEVELS + 1) ** POWER >> SHIFT
    return _digits(weights[:, None])


def _pull(graph: Graph, width: Symbol) -> Symbol:
    """``width * ONE // PULL`` in digits that may exceed the radix."""
    whole, rest = divmod(ONE, PULL)
    more = (width * rest // PULL).to("float32") * graph.constant(_digits(np.array([1])))
    return graph.constant(_digits(np.array([whole]))) * width.to("float32") + more


def _digits(numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    return (numbers // RADIX ** np.arange(DIGITS) % RADIX).astype(np.float32)
