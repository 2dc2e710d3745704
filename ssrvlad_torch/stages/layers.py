"""Categories and layers: label ids -> Table II -> one binary layer per category."""

import numpy as np
import torch
from torch import Tensor

from ..taxonomy import NO_LAYER, LabelSpace
from .tracing import exporting, looked_up

UNKNOWN = 255


def best_class(scores: Tensor) -> Tensor:
    """``(B, H, W)`` int64, the class of the largest of class scores ``(B, C, H, W)``; of equal
    scores, the first class. A score that is NaN is a ValueError; a graph cannot raise, and does not
    detect it."""
    if exporting():
        return scores.argmax(1)
    return (_operator if torch.compiler.is_compiling() else _best_class)(scores)


def _best_class(scores: Tensor) -> Tensor:
    largest, label = scores.max(1)  # the index of argmax(1), much faster on a CPU; NaN is largest
    if bool(largest.isnan().any()):
        count = int(scores.isnan().sum())
        raise ValueError(f"class scores hold {count} NaN values; expected none")
    return label


_operator = torch.library.custom_op("ssrvlad::best_class", _best_class, mutates_args=())
"""For `torch.compile`, which cannot follow the check."""


@_operator.register_fake
def _(scores: Tensor) -> Tensor:
    return scores.new_empty((scores.shape[0], *scores.shape[2:]), dtype=torch.int64)


def category_table(space: LabelSpace) -> tuple[Tensor, int]:
    """Look-up table of a label space, and the index of id 0 in it.

    ``(T,)`` uint8: at ``origin + id`` the category 0 to 7 of the id, `NO_LAYER` for a dynamic or
    void id, `UNKNOWN` for one that the space lacks. The table covers ids 0 to 255. Both its ends
    are unknown, so an id outside the table, clamped, is unknown."""
    ids = [label.id for label in space.classes]
    origin = 1 - min(0, *ids)
    table = torch.full((origin + max(255, *ids) + 2,), UNKNOWN, dtype=torch.uint8)
    for label in space.classes:
        table[origin + label.id] = label.category_index
    return table, origin


def categorise(labels: Tensor, table: Tensor, origin: int) -> Tensor:
    """The category ``(B, H, W)`` uint8, 0 to 7, `NO_LAYER` or `UNKNOWN`, of every pixel of a label
    map of any integer dtype, by a `category_table`."""
    entries = labels.to(torch.int64)
    if labels.dtype == torch.uint8:  # the table has all of them
        table = table[origin:]
    else:
        if labels.dtype == torch.uint64:  # beyond int64: in no label space
            entries = torch.where(entries < 0, len(table), entries)
        entries = entries.clamp(-origin, len(table) - 1 - origin) + origin
    return looked_up(table, entries.flatten()).view(labels.shape)


def refuse_unknown(labels: Tensor, space: LabelSpace) -> None:
    """Raises a ValueError if label maps hold an id that is not in the label space. It names the
    lowest one, its pixel count and the label space."""
    ids, counts = np.unique(labels.cpu().numpy(), return_counts=True)
    defined = {label.id for label in space.classes}
    pairs = zip(ids.tolist(), counts.tolist(), strict=True)
    unknown = [(id, count) for id, count in pairs if id not in defined]
    if not unknown:
        return
    (first, count), *further = unknown
    pixels = f"{count} pixel{'s'[: count > 1]}"
    more = f", like {len(further)} more" if further else ""
    raise ValueError(
        f"label id {first} ({pixels}) is not in label space {space.name}{more}; expected "
        f"{space.describe_ids()}"
    )


def merge(categories: Tensor) -> Tensor:
    """Six layers from eight: guard rail (6) counts as building (2), parking (7) as ground (0).
    Fewer networks distinguish all eight. ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`, become int64, 0
    to 5, or 6 for none."""
    table = torch.tensor((0, 1, 2, 3, 4, 5, 2, 0, 6), device=categories.device)
    return looked_up(table, categories.to(torch.int64).flatten()).view(categories.shape)


def split(categories: Tensor) -> Tensor:
    """Bit-planes of categories ``(B, H, W)`` uint8, 0 to 7 or `NO_LAYER`: bit ``k`` is set where
    the category is ``k``."""
    bits = torch.tensor([*(1 << k for k in range(NO_LAYER)), 0], dtype=torch.uint8)
    return bits.to(categories.device)[categories.long()]
