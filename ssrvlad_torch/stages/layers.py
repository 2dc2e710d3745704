"""Categories and layers: label ids -> Table II -> one binary layer per category."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..deployment.graph import Graph, Symbol
from ..deployment.words import PIXELS, Grid, Words
from ..taxonomy import NO_LAYER, LabelSpace

UNKNOWN = 255


def category_table(space: LabelSpace) -> tuple[Tensor, int]:
    """Look-up table of a label space, and the entry of id 0.

    Returns:
        ``(T,)`` uint8: at ``origin + id`` the category 0 to 7 of the id, `NO_LAYER` for a
        dynamic or void id, `UNKNOWN` for an id that the space does not define. The table covers
        all bytes; both its ends are unknown, so that an id clamped into it is unknown as well.
    """
    ids = [label.id for label in space.classes]
    origin = 1 - min(0, *ids)
    table = torch.full((origin + max(255, *ids) + 2,), UNKNOWN, dtype=torch.uint8)
    for label in space.classes:
        table[origin + label.id] = label.category_index
    return table, origin


def categorise(labels: Tensor, table: Tensor, origin: int) -> Tensor:
    """Category of every pixel.

    Args:
        labels: ``(B, H, W)`` label map of any integer dtype.
        table, origin: from `category_table`.

    Returns:
        ``(B, H, W)`` uint8: 0 to 7, `NO_LAYER` or `UNKNOWN`.
    """
    if labels.dtype == torch.uint8:
        entries, table = labels.to(torch.int32), table[origin : origin + 256]
    else:
        wide = labels.to(torch.int64)
        if labels.dtype == torch.uint64:
            wide = torch.where(wide < 0, len(table), wide)  # beyond int64: no id of any space
        entries = wide.clamp(-origin, len(table) - 1 - origin) + origin
    return table.index_select(0, entries.flatten()).view(labels.shape)


def refuse_unknown(labels: Tensor, categories: Tensor, space: LabelSpace) -> None:
    """Checks that every id is one of the label space.

    Args:
        labels: the whole label maps, for the message.
        categories: of some of them, from `categorise`.
        space: the label space.

    Raises:
        ValueError: names the lowest unknown id, its pixel count and the label space.
    """
    if int(categories.max()) < UNKNOWN:
        return
    ids, counts = labels.to(torch.int64).unique(return_counts=True)
    known = torch.tensor([label.id for label in space.classes], device=ids.device)
    unknown = ~torch.isin(ids, known)
    more = f" and {int(unknown.sum()) - 1} other ids" if int(unknown.sum()) > 1 else ""
    raise ValueError(
        f"label id {int(ids[unknown][0])} ({int(counts[unknown][0])} pixels){more} is not in "
        f"label space {space.name}; wanted {space.describe_ids()}"
    )


def entries_in_graph(
    graph: Graph, labels: Symbol, table: Tensor, origin: int
) -> tuple[Symbol, npt.NDArray[np.uint8]]:
    """`categorise` in a graph, up to the look-up itself.

    Args:
        graph: where the nodes go.
        labels: label ids of any shape, uint8 or int64.
        table, origin: from `category_table`.

    Returns:
        ``(n,)`` int32, for each of the n pixels its entry in the table, and the table for this
        dtype, ``(T,)`` uint8.
    """
    if labels.dtype == "uint8":
        return labels.to("int32").reshape(-1), table[origin : origin + 256].numpy()
    entries = graph.Min(graph.Max(labels, -origin), len(table) - 1 - origin) + origin
    return entries.to("int32").reshape(-1), table.numpy()


def categorise_in_graph(
    graph: Graph, entries: Symbol, table: npt.NDArray[np.uint8], size: tuple[Symbol, Symbol]
) -> tuple[Symbol, Symbol]:
    """The look-up of `categorise` in a graph, for one image.

    Args:
        graph: where the nodes go.
        entries, table: from `entries_in_graph`.
        size: H and W, ``()`` int64.

    Returns:
        ``(H, W)`` uint8, and ``()`` int64, the number of unknown ids.
    """
    categories = graph.constant(table).take(entries).reshape(*size)
    is_unknown = categories.to("int32").equals(UNKNOWN).to("float32")
    by_row = graph.ReduceSum(is_unknown, [1], keepdims=0)  # exact: a row has no 2 ** 24 pixels
    return categories, graph.ReduceSum(by_row.to("int64"), keepdims=0)


def split_in_graph(graph: Graph, categories: Symbol, grid: Grid) -> Words:
    """`split` in a graph: the bits of each eight pixels of a row make a word.

    They are added up by halves: ONNX Runtime's ``ReduceSum`` is exact to 53 bits only.

    Args:
        graph: where the nodes go.
        categories: ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER` or `UNKNOWN`.
        grid: of that size.
    """
    right = grid.pitch * PIXELS - grid.width
    padded = graph.Pad(categories, graph.vector(0, 0, 0, 0, 1, right), NO_LAYER)
    kinds = NO_LAYER + 1
    bits = np.zeros((PIXELS, kinds), np.uint64)
    for pixel, kind in np.ndindex(PIXELS, NO_LAYER):
        bits[pixel, kind] = 1 << 8 * pixel + kind
    pixels = graph.Transpose(padded.reshape(-1, PIXELS), perm=[1, 0])
    first = graph.constant(np.arange(PIXELS, dtype=np.int32)[:, None] * kinds)
    words = graph.constant(bits.view(np.int64).ravel()).take(
        (graph.Min(pixels.to("int32"), NO_LAYER) + first).reshape(-1)
    )
    for _ in range(3):
        left, right = graph.split(words, 2)
        words = left + right
    return Words(words, grid)


def split(categories: Tensor) -> Tensor:
    """One layer per category.

    Args:
        categories: ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`.

    Returns:
        ``(B, H, W)`` uint8 bit-planes, bit ``k`` set where the category is ``k``.
    """
    return torch.ones_like(categories) << categories  # 1 << 8 has no bit in a byte
