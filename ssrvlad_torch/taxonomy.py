"""Label spaces and the eight categories of Table II.

A label space says what the ids of a label map mean. Each id belongs to one of the eight
categories, or to `DYNAMIC` or `VOID`, which get no layer. The built-in spaces are YAML files in
``label_spaces/``; a user's own space is a file of the same form.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

CATEGORIES = (
    "ground",
    "sidewalk",
    "building",
    "pole",
    "vegetation",
    "sky",
    "guard-rail",
    "parking",
)
"""Table II in order: block ``k`` of a descriptor is ``CATEGORIES[k]``."""

DYNAMIC = "dynamic"
VOID = "void"
NO_LAYER = len(CATEGORIES)
"""Category index of every pixel that belongs to no layer."""


@dataclass(frozen=True)
class LabelClass:
    """One id of a label space: ``category`` is in `CATEGORIES`, or `DYNAMIC` or `VOID`; the colour
    is what pictures of label maps show it in, if any."""

    id: int
    name: str
    category: str
    colour: tuple[int, int, int] | None

    @property
    def category_index(self) -> int:
        """0 to 7, or `NO_LAYER`."""
        return CATEGORIES.index(self.category) if self.category in CATEGORIES else NO_LAYER


@dataclass(frozen=True)
class LabelSpace:
    """The ids that a label map may hold, and what they mean."""

    name: str
    source: str
    classes: tuple[LabelClass, ...]

    @property
    def channel_counts(self) -> range:
        """Class counts that a network's scores may have, channel ``c`` standing for id ``c``.

        Void classes at the end may be left out: CamVid networks have 11 or 12 channels.
        """
        ids = {label.id for label in self.classes}
        meant = max(label.id for label in self.classes if label.category != VOID)
        most = next(count for count in range(len(ids) + 1) if count not in ids)
        return range(meant + 1, most + 1)

    def describe_ids(self) -> str:
        """The ids in words, for messages: ``0 to 18, 255``."""
        ids = sorted(label.id for label in self.classes)
        spans: list[list[int]] = []
        for label_id in ids:
            if spans and spans[-1][1] == label_id - 1:
                spans[-1][1] = label_id
            else:
                spans.append([label_id, label_id])
        return ", ".join(str(low) if low == high else f"{low} to {high}" for low, high in spans)


def label_space_names() -> tuple[str, ...]:
    """Names of the built-in label spaces."""
    files = resources.files(__package__).joinpath("label_spaces").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files))


@cache
def label_space(name: str) -> LabelSpace:
    """A built-in label space, or the one that a YAML file defines.

    Args:
        name: a name in `label_space_names`, or the path of a file that ends in ``.yaml`` or
            ``.yml``.

    Raises:
        ValueError: no such space, or the file does not define one; the message names the entry.

    Example:
        >>> label_space("camvid-11").classes[0].category
        'sky'
    """
    if name.endswith((".yaml", ".yml")):
        try:
            text = Path(name).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"cannot read the label space {name}: {error}") from error
    elif name in label_space_names():
        text = resources.files(__package__).joinpath(f"label_spaces/{name}.yaml").read_text("utf-8")
    else:
        raise ValueError(
            f"unknown label space {name!r}; wanted one of {', '.join(label_space_names())}, "
            "or the path of a .yaml file"
        )
    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"{name} is not YAML: {' '.join(str(error).split())}") from error
    return _parse(document, name)


def palette(name: str) -> npt.NDArray[np.uint8]:
    """(256, 3) colours of a label space's ids 0 to 255; black where it defines none."""
    colours = np.zeros((256, 3), np.uint8)
    for label in label_space(name).classes:
        if 0 <= label.id < 256 and label.colour:
            colours[label.id] = label.colour
    return colours


def colourise(labels: npt.NDArray[Any], name: str) -> npt.NDArray[np.uint8]:
    """An ``(H, W)`` label map as an ``(H, W, 3)`` RGB picture in the label space's colours.

    Ids that the space does not define are magenta.
    """
    picture = np.full((*labels.shape, 3), (255, 0, 255), np.uint8)
    for label in label_space(name).classes:
        picture[labels == label.id] = label.colour or (0, 0, 0)
    return picture


def _parse(document: object, where: str) -> LabelSpace:
    wanted = "wanted a mapping with name, source and classes"
    if not isinstance(document, dict) or not {"name", "source", "classes"} <= document.keys():
        raise ValueError(f"{where} is not a label space: {wanted}")
    if not isinstance(document["classes"], list) or not document["classes"]:
        raise ValueError(f"{where}: classes must be a list with at least one class")
    classes = tuple(_parse_class(entry, where) for entry in document["classes"])
    repeated = [key for key, count in Counter(label.id for label in classes).items() if count > 1]
    if repeated:
        raise ValueError(f"{where}: id {repeated[0]} is defined more than once")
    if all(label.category == VOID for label in classes):
        raise ValueError(f"{where}: every class is void, so no label map could mean anything")
    return LabelSpace(str(document["name"]), str(document["source"]), classes)


def _parse_class(entry: object, where: str) -> LabelClass:
    if not isinstance(entry, dict) or not {"id", "name", "category"} <= entry.keys():
        raise ValueError(f"{where}: class {entry!r} must have id, name and category")
    identity, category = entry["id"], entry["category"]
    if not isinstance(identity, int) or isinstance(identity, bool) or abs(identity) > 65535:
        raise ValueError(f"{where}: id {identity!r} must be an integer from -65535 to 65535")
    if category not in (*CATEGORIES, DYNAMIC, VOID):
        raise ValueError(
            f"{where}: id {identity} has category {category!r}; "
            f"wanted one of {', '.join((*CATEGORIES, DYNAMIC, VOID))}"
        )
    colour = entry.get("colour")
    if colour is not None and not _is_colour(colour):
        raise ValueError(f"{where}: id {identity} has colour {colour!r}; wanted three of 0 to 255")
    return LabelClass(
        identity, str(entry["name"]), category, None if colour is None else tuple(colour)
    )


def _is_colour(value: object) -> bool:
    return (
        isinstance(value, (list, tuple))
        and len(value) == 3
        and all(isinstance(part, int) and 0 <= part < 256 for part in value)
    )
