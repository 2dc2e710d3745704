"""Categories and layers: label ids -> Table II -> one binary layer per category."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..taxonomy import NO_LAYER, LabelSpace

UNKNOWN = 255


def category_table(space: LabelSpace) -> tuple[Tensor, int]:
    """Look-up table of a label space and the id of its first entry.

    Returns:
        ``(T,)`` uint8: the category 0 to 7 of id ``lowest + entry``, `NO_LAYER` for a dynamic or
        void id, `UNKNOWN` for an id that the space does not define. Both ends of the table are
        unknown, so that an id clamped into it is unknown as well.
    """
    ids = [label.id for label in space.classes]
    lowest = min(ids) - 1
    table = torch.full((max(ids) - lowest + 2,), UNKNOWN, dtype=torch.uint8)
    for label in space.classes:
        table[label.id - lowest] = label.category_index
    return table, lowest


def categorise(labels: Tensor, table: Tensor, lowest: int) -> Tensor:
    """Category of every pixel.

    Args:
        labels: ``(B, H, W)`` label map of any integer dtype.
        table, lowest: from `category_table`.

    Returns:
        ``(B, H, W)`` uint8: 0 to 7, `NO_LAYER` or `UNKNOWN`.
    """
    wide = labels if labels.dtype == torch.int64 else labels.to(torch.int32)
    entry = (wide.clamp(lowest, lowest + len(table) - 1) - lowest).to(torch.int32)
    return table.index_select(0, entry.flatten()).view(labels.shape)


def refuse_unknown(labels: Tensor, categories: Tensor, space: LabelSpace) -> None:
    """Checks that every id of the label map is one of the label space.

    Raises:
        ValueError: names the first unknown id, its pixel count and the label space.
    """
    unknown = categories == UNKNOWN
    if not bool(unknown.any()):
        return
    ids, counts = labels[unknown].to(torch.int64).unique(return_counts=True)
    more = f" and {len(ids) - 1} other ids" if len(ids) > 1 else ""
    raise ValueError(
        f"label id {int(ids[0])} ({int(counts[0])} pixels){more} is not in label space "
        f"{space.name}; wanted {space.describe_ids()}"
    )


def split(categories: Tensor) -> Tensor:
    """One layer per category.

    Args:
        categories: ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`.

    Returns:
        ``(B, H, W)`` uint8 bit-planes, bit ``k`` set where the category is ``k``.
    """
    bits: Sequence[int] = [1 << category for category in range(NO_LAYER)] + [0]
    table = torch.tensor(bits, dtype=torch.uint8, device=categories.device)
    return table.index_select(0, categories.flatten().to(torch.int32)).view(categories.shape)
