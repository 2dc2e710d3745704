"""From the ids of a network to ids of the head, by a table of class names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ssrvlad_torch.taxonomy import CATEGORIES, DYNAMIC, VOID, label_space, label_space_names

LABELS_AS = "cityscapes-ids"
"""The label space of the output of `LabelTable`; it has all eight categories."""

_UNKNOWN = 255


class LabelTable:
    """Turns a network's ids into those of `LABELS_AS` that belong to the same categories.

    The category of a class is that of its name in the label spaces of the package, first of that
    which has most of the names; only letters and digits count, in any case. The largest id of an
    image's dtype, 255 or 65535, is unlabelled unless the table has it, as in
    ``vision_msgs/LabelInfo``.

    Args:
        class_map: ids from 0 to 65535 and names of the classes.
        meanings: categories by name, for names that no label space has or that mean something
            else: one of `taxonomy.CATEGORIES`, ``dynamic`` or ``void``.

    Raises:
        ValueError: the table is empty, an id occurs twice, or the meaning of names is unknown.
    """

    def __init__(
        self, class_map: Iterable[tuple[int, str]], meanings: Mapping[str, str] | None = None
    ) -> None:
        names: dict[int, str] = {}
        for identity, name in class_map:
            if identity in names or not 0 <= identity <= 65535:
                raise ValueError(f"id {identity} of {name!r} stands twice or is not 0 to 65535")
            names[identity] = name
        categories = _meanings(names.values())
        categories |= {_plain(name): _category(c) for name, c in (meanings or {}).items()}
        strange = [repr(name) for name in names.values() if _plain(name) not in categories]
        if strange or not names:
            raise ValueError(
                f"the label table has {len(names)} classes, of unknown meaning: "
                f"{', '.join(strange) or 'all'}; say name=category, of "
                f"{', '.join((*CATEGORIES, DYNAMIC, VOID))}"
            )
        self._ids = np.full(65536, _UNKNOWN, np.uint8)
        for identity, name in names.items():
            self._ids[identity] = _ids()[categories[_plain(name)]]

    def __call__(self, labels: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """From an ``(H, W)`` uint8 or uint16 image of a network's ids to one of ids in `LABELS_AS`.

        Raises:
            ValueError: the table lacks ids of the image; the message names one.
        """
        mapped = self._ids[labels]
        unlabelled = labels == np.iinfo(labels.dtype).max
        mapped[unlabelled & (mapped == _UNKNOWN)] = _ids()[VOID]
        wrong = mapped == _UNKNOWN
        if wrong.any():
            raise ValueError(
                f"{wrong.sum()} of {labels.size} pixels have an id that the label table lacks, "
                f"such as {labels[wrong][0]}"
            )
        return mapped


def _meanings(names: Iterable[str]) -> dict[str, str]:
    """Categories by the names of all classes of all label spaces; where these differ, as on a lamp,
    by that which has most of the given names, `LABELS_AS` before the others."""
    plain = set(map(_plain, names))
    spaces = [{_plain(c.name): c.category for c in label_space(LABELS_AS).classes}]
    spaces += [
        {_plain(c.name): c.category for c in label_space(name).classes}
        for name in label_space_names()
    ]
    spaces.sort(key=lambda categories: -len(plain & categories.keys()))
    return {name: category for space in reversed(spaces) for name, category in space.items()}


def _ids() -> dict[str, int]:
    """An id of `LABELS_AS` for each category."""
    return {
        label.category: label.id
        for label in reversed(label_space(LABELS_AS).classes)
        if label.id >= 0
    }


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _category(name: str) -> str:
    if name not in (*CATEGORIES, DYNAMIC, VOID):
        expected = ", ".join((*CATEGORIES, DYNAMIC, VOID))
        raise ValueError(f"unknown category {name!r}; expected one of {expected}")
    return name
