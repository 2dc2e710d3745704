"""Reduction as ONNX operators."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol


def reduce_by_majority_in_graph(
    graph: Graph,
    entries: Symbol,
    table: npt.NDArray[np.uint8],
    size: tuple[Symbol, Symbol],
    grid: tuple[Symbol, Symbol],
) -> tuple[Symbol, Symbol]:
    """`reduce_by_majority` in a graph, for one image whose ids are not looked up yet.

    A cell's votes are the difference of running sums at its ends, down the rows and along the
    columns; the sums may wrap, the differences do not mind. The votes for no layer are what the
    others leave of the cell, which frees a field of the words for the count of unknown ids.

    Args:
        graph: where the nodes go.
        entries: ``(H * W,)`` int32, for each pixel its entry in the table.
        table: ``(T,)`` uint8, 0 to 7, `NO_LAYER`, or above it for an unknown id, which votes as if
            it had no layer.
        size: H and W, ``()`` int64.
        grid: h and w, likewise.

    Returns:
        ``(h, w)`` uint8, and ``()`` int64, the number of unknown ids.
    """
    ends = [
        ((graph.arange(cells) + 1) * pixels + cells - 1) // cells
        for pixels, cells in zip(size, grid, strict=True)
    ]
    rows, columns = (_differences(graph, end, 0, [1, 0]) for end in ends)
    area = rows.reshape(-1, 1) * columns
    powers, kinds = graph.constant(1 << np.arange(63)), graph.constant(np.arange(NO_LAYER + 1))
    largest = graph.ReduceMax(area, keepdims=0)
    bits = graph.ReduceSum((powers <= largest).to("int64"), keepdims=0)
    fields, all_set = 63 // bits, powers.take(bits.reshape(1)) - 1
    kind = np.where(table == NO_LAYER, NO_LAYER + 1, np.minimum(table, NO_LAYER))

    def count(step: Symbol, votes: Symbol) -> list[Symbol]:
        field = kinds - step * fields
        kept = ((field >= 0) & (field < fields)).to("int64")
        shift, mask = field * bits * kept, all_set * kept
        word = graph.Pad(powers.take(shift) * kept, [0, 1])
        words = word.take(graph.constant(kind.astype(np.int64))).take(entries).reshape(*size)
        for axis, margins in enumerate(([1, 0, 0, 0], [0, 1, 0, 0])):
            sums = graph.Gather(graph.CumSum(words, axis), ends[axis] - 1, axis=axis)
            words = _differences(graph, sums, axis, margins)
        shift, mask, words = (x.to("uint64") for x in (shift, mask, words))
        counted = words >> shift.reshape(-1, 1, 1) & mask.reshape(-1, 1, 1)
        return [votes + counted.to("int64")]

    passes = (fields + NO_LAYER) // fields
    (votes,) = graph.repeat(passes, count, graph.full([NO_LAYER + 1, *grid], 0, "int64"))
    rest = area - graph.ReduceSum(votes[:NO_LAYER], [0], keepdims=0)
    ballot = graph.Concat(votes[:NO_LAYER], rest.reshape(1, *grid), axis=0)
    winner = graph.ArgMax(ballot.to("int32"), axis=0, keepdims=0).to("uint8")
    return winner, graph.ReduceSum(votes[NO_LAYER], keepdims=0)


def _differences(graph: Graph, sums: Symbol, axis: int, margins: list[int]) -> Symbol:
    """Each entry less the one before it, the first as it is."""
    return sums - graph.Slice(graph.Pad(sums, margins), [0], [-1], [axis])
