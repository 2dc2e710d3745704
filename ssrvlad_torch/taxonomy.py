"""Label spaces and the eight categories of Table II.

A label space says what the ids of a label map mean. Each id belongs to one of the eight
categories, or to `DYNAMIC` or `VOID`, which get no layer. The built-in spaces are YAML files in
``label_spaces/``; a custom space is a file of the same form, or a `LabelSpace`."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from importlib import resources
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from .files import MAX_YAML_BYTES, one_line, parse_yaml, read_text

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
    """One id of a label space, -65535 to 65535: the name of the class, for people; its category,
    one of `CATEGORIES`, or `DYNAMIC` or `VOID`; and its colour in pictures of label maps, if it has
    one."""

    id: int
    name: str
    category: str
    colour: tuple[int, int, int] | None = None

    @property
    def category_index(self) -> int:
        """0 to 7, or `NO_LAYER`."""
        return CATEGORIES.index(self.category) if self.category in CATEGORIES else NO_LAYER


@dataclass(frozen=True)
class LabelSpace:
    """The ids that a label map may hold, and what they mean.

    Attributes:
        name: of the label space.
        source: where the ids are defined: a paper, a data set, a network.
        classes: one for each id.

    Examples:
        >>> path = {"id": 7, "name": "path", "category": "ground"}
        >>> space = LabelSpace.from_dict({"name": "mine", "source": "me", "classes": [path]})
        >>> space.classes[0].category_index
        0
    """

    name: str
    source: str
    classes: tuple[LabelClass, ...]

    @classmethod
    def from_dict(cls, document: object, where: str = "label space") -> LabelSpace:
        """The label space that `to_dict` wrote, or that a YAML file holds: a mapping with ``name``,
        ``source`` and ``classes``, a list of mappings with ``id``, ``name``, ``category`` and
        optionally ``colour``. Other documents are a ValueError that names ``where`` it is from, and
        the entry."""
        expected = "expected a mapping with name, source and classes"
        if not isinstance(document, dict) or not {"name", "source", "classes"} <= document.keys():
            raise ValueError(f"{where} is not a label space: {expected}")
        if not isinstance(document["classes"], (list, tuple)) or not document["classes"]:
            raise ValueError(f"{where}: classes must be a list with at least one class")
        classes, categories = [], (*CATEGORIES, DYNAMIC, VOID)
        for entry in document["classes"]:
            if not isinstance(entry, dict) or not {"id", "name", "category"} <= entry.keys():
                raise ValueError(f"{where}: class {entry!r} must have id, name and category")
            label_id, category, colour = entry["id"], entry["category"], entry.get("colour")
            if not isinstance(label_id, int) or isinstance(label_id, bool) or abs(label_id) > 65535:
                raise ValueError(
                    f"{where}: id {label_id!r} must be an integer from -65535 to 65535"
                )
            if category not in categories:
                raise ValueError(
                    f"{where}: id {label_id} has category {category!r}; "
                    f"expected one of {', '.join(categories)}"
                )
            if colour is not None:
                parts = colour if isinstance(colour, (list, tuple)) else ()
                if len(parts) != 3 or not all(isinstance(p, int) and 0 <= p < 256 for p in parts):
                    raise ValueError(
                        f"{where}: id {label_id} has colour {colour!r}; expected three of 0 to 255"
                    )
                colour = tuple(parts)
            classes.append(LabelClass(label_id, str(entry["name"]), category, colour))
        counts = Counter(label.id for label in classes)
        repeated = [label_id for label_id, count in counts.items() if count > 1]
        if repeated:
            raise ValueError(f"{where}: id {repeated[0]} is defined more than once")
        if all(label.category == VOID for label in classes):
            raise ValueError(f"{where}: every class is void, so no label map could mean anything")
        return cls(str(document["name"]), str(document["source"]), tuple(classes))

    def to_dict(self) -> dict[str, Any]:
        """The label space as a mapping, ready for JSON."""
        classes: list[dict[str, Any]] = []
        for label in self.classes:
            classes.append({"id": label.id, "name": label.name, "category": label.category})
            if label.colour is not None:
                classes[-1]["colour"] = list(label.colour)
        return {"name": self.name, "source": self.source, "classes": classes}

    @property
    def digest(self) -> str:
        """16 hex digits over the classes: ids, names, categories and colours, in the order of ids.

        Label spaces with equal digests read every label map alike; their names may differ."""
        classes = sorted(self.to_dict()["classes"], key=itemgetter("id"))
        return hashlib.sha256(json.dumps(classes, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def channel_counts(self) -> range:
        """Numbers of channels that a network's scores may have; channel ``c`` stands for id ``c``.

        Void classes at the end may be left out: CamVid networks have 11 or 12 channels."""
        ids = {label.id for label in self.classes}
        last = max(label.id for label in self.classes if label.category != VOID)
        most = next(count for count in range(len(ids) + 1) if count not in ids)
        return range(last + 1, most + 1)

    def describe_ids(self) -> str:
        """The ids as text for messages: ``0 to 18, 255``."""
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


def label_space(labels_as: str | os.PathLike[str] | LabelSpace) -> LabelSpace:
    """A built-in label space by its name, the one that a YAML file at a path defines, or
    ``labels_as`` itself. A file is read at every call, so that its changes take effect. An unknown
    name, and a file that defines none, are a ValueError.

    Examples:
        >>> label_space("camvid-11").classes[0].category
        'sky'
    """
    if isinstance(labels_as, LabelSpace):
        return labels_as
    name = os.fspath(labels_as)
    if name.endswith((".yaml", ".yml")):
        try:
            text = read_text(name, MAX_YAML_BYTES)
        except (OSError, ValueError) as error:
            raise ValueError(f"cannot read the label space {name}: {one_line(error)}") from error
        return _parsed(text, name)
    names = label_space_names()
    if name not in names:
        close = get_close_matches(name, names, n=2, cutoff=0.6)
        hint = f"did you mean {' or '.join(sorted(close))}? " if close else ""
        raise ValueError(
            f"unknown label space {name!r}: {hint}Expected one of {', '.join(names)}, or "
            "the path of a .yaml file"
        )
    file = resources.files(__package__).joinpath(f"label_spaces/{name}.yaml")
    return _parsed(file.read_text("utf-8"), name)


@lru_cache(maxsize=32)
def _parsed(text: str, where: str) -> LabelSpace:
    return LabelSpace.from_dict(parse_yaml(text, where), where)


def palette(space: str | os.PathLike[str] | LabelSpace) -> npt.NDArray[np.uint8]:
    """``(256, 3)`` colours of a label space's ids 0 to 255; black for ids without a colour."""
    colours = np.zeros((256, 3), np.uint8)
    for label in label_space(space).classes:
        if 0 <= label.id < 256 and label.colour:
            colours[label.id] = label.colour
    return colours


def colourise(
    labels: npt.NDArray[Any], space: str | os.PathLike[str] | LabelSpace
) -> npt.NDArray[np.uint8]:
    """An ``(H, W)`` label map as an ``(H, W, 3)`` RGB picture in the label space's colours.

    Ids that the space does not define are magenta."""
    picture = np.full((*labels.shape, 3), (255, 0, 255), np.uint8)
    for label in label_space(space).classes:
        picture[labels == label.id] = label.colour or (0, 0, 0)
    return picture
