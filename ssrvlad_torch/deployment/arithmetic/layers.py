"""Layers as arithmetic."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from ...config import AREA_LAYERS
from ...stages.layers import merge
from ...stages.vanishing_column import OPEN_LAYERS
from ...taxonomy import NO_LAYER
from ..graph import Graph, Symbol
from .reduction import Side


class Layers(NamedTuple):
    """The layers of each cell, float32.

    Attributes:
        masks: ``(B, 6, h, w)``, 1 inside each of the merged layers and 0 outside.
        number: ``(B, 1, h, w)``, the number of the merged layer, 6 for none.
        is_open: ``(B, 1, h, w)``, 1 inside `OPEN_LAYERS` and 0 outside.
    """

    masks: Symbol
    number: Symbol
    is_open: Symbol


def layers_in_graph(graph: Graph, votes: Symbol, rows: Side, columns: Side) -> Layers:
    """`split` and `merge` in a graph, for the first of the most frequent kinds of each cell.

    Args:
        graph: the graph to add nodes to.
        votes: ``(B, 9, h * w)`` float32, the votes for eight layers and for no layer.
        rows, columns: the h and w cells.
    """
    kinds = NO_LAYER + 1
    most = graph.Max(*graph.split(votes, kinds, axis=1))
    is_most = votes.equals(most).to("float32")
    unless_earlier = np.eye(kinds, dtype=np.float32) - np.tri(kinds, k=-1, dtype=np.float32)
    is_first = graph.Relu(graph.MatMul(graph.constant(unless_earlier), is_most))
    values = graph.MatMul(graph.constant(_layer_table()), is_first)
    values = values.reshape(-1, AREA_LAYERS + 2, rows.cells, columns.cells)
    ends = (0, AREA_LAYERS, AREA_LAYERS + 1, AREA_LAYERS + 2)
    return Layers(*(graph.Slice(values, [a], [b], [1]) for a, b in pairwise(ends)))


def layers_of_categories(graph: Graph, categories: Symbol) -> Layers:
    """`split` and `merge` in a graph.

    Args:
        graph: the graph to add nodes to.
        categories: ``(B, h, w)`` uint8, 0 to 7, or larger for no layer.
    """
    kind = graph.Min(graph.Unsqueeze(categories, [1]).to("int32"), NO_LAYER)
    shape = graph.Shape(kind)
    number, is_open = (
        graph.Reshape(graph.constant(row).take(kind.reshape(-1)), shape)
        for row in _layer_table()[AREA_LAYERS:]
    )
    each = graph.constant(np.arange(AREA_LAYERS, dtype=np.float32)[:, None, None])
    return Layers(number.equals(each).to("float32"), number, is_open)


def _layer_table() -> npt.NDArray[np.float32]:
    """``(6 + 2, 9)`` float32, the attributes of `Layers` for each kind."""
    merged = merge(1 << torch.arange(NO_LAYER + 1) & 0xFF).numpy()
    masks = merged >> np.arange(AREA_LAYERS)[:, None] & 1
    number = np.append(masks, [1 - masks.sum(0)], axis=0).argmax(0)
    return np.concatenate((masks, [number, merged & OPEN_LAYERS != 0])).astype(np.float32)
