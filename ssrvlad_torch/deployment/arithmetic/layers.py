"""Layers as arithmetic."""

from __future__ import annotations

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
    """What there is in each cell, float32.

    Attributes:
        masks: ``(B, 6, h, w)``, 1 in each of the merged layers and 0 outside.
        number: ``(B, 1, h, w)``, the number of the layer, 6 for none.
        is_open: ``(B, 1, h, w)``, 1 in `OPEN_LAYERS` and 0 outside.
    """

    masks: Symbol
    number: Symbol
    is_open: Symbol


def layers_in_graph(graph: Graph, votes: Symbol, rows: Side, columns: Side) -> Layers:
    """`split` and `merge` in a graph, of the commonest kind of each cell, the first of equals.

    Args:
        graph: where the nodes go.
        votes: ``(B, 9, h * w)`` float32, of eight layers and of none.
        rows, columns: h and w cells.
    """
    kinds = NO_LAYER + 1
    most = graph.Max(*graph.split(votes, kinds, axis=1))
    is_most = votes.equals(most).to("float32")
    unless_before = np.eye(kinds, dtype=np.float32) - np.tri(kinds, k=-1, dtype=np.float32)
    is_first = graph.Relu(graph.MatMul(graph.constant(unless_before), is_most))
    found = graph.MatMul(graph.constant(_of_kinds()), is_first)
    found = found.reshape(-1, AREA_LAYERS + 2, rows.cells, columns.cells)
    masks = graph.Slice(found, [0], [AREA_LAYERS], [1])
    return Layers(
        masks,
        graph.Slice(found, [AREA_LAYERS], [AREA_LAYERS + 1], [1]),
        graph.Slice(found, [AREA_LAYERS + 1], [AREA_LAYERS + 2], [1]),
    )


def layers_of_categories(graph: Graph, categories: Symbol) -> Layers:
    """`split` and `merge` in a graph.

    Args:
        graph: where the nodes go.
        categories: ``(B, h, w)`` uint8, 0 to 7, or above for none.
    """
    kind = graph.Min(graph.Unsqueeze(categories, [1]).to("int32"), NO_LAYER)
    shape = graph.Shape(kind)
    number, is_open = (
        graph.Reshape(graph.constant(row).take(kind.reshape(-1)), shape)
        for row in _of_kinds()[AREA_LAYERS:]
    )
    each = graph.constant(np.arange(AREA_LAYERS, dtype=np.float32)[:, None, None])
    return Layers(number.equals(each).to("float32"), number, is_open)


def _of_kinds() -> npt.NDArray[np.float32]:
    """``(6 + 2, 9)`` float32, the attributes of `Layers` for each kind."""
    merged = merge(1 << torch.arange(NO_LAYER + 1) & 0xFF).numpy()
    masks = merged >> np.arange(AREA_LAYERS)[:, None] & 1
    number = np.append(masks, [1 - masks.sum(0)], axis=0).argmax(0)
    return np.concatenate((masks, [number, merged & OPEN_LAYERS != 0])).astype(np.float32)
