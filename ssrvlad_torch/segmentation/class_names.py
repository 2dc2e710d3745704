"""Label spaces from class names: the name of a network's class gives its category."""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import resources

import yaml

from ..taxonomy import CATEGORIES, DYNAMIC, VOID, LabelClass, LabelSpace


def category_of_name(name: str) -> str | None:
    """The category of a class by its name, from ``class_names.yaml``: one of `CATEGORIES`,
    `DYNAMIC` for what moves, `VOID` without a category, or ``None`` for a name that is not in the
    table.

    Examples:
        >>> category_of_name("construction--flat--road")
        'ground'
    """
    table = _table()
    return next((table[form] for form in _forms(name) if form in table), None)


def label_space_of_names(names: Mapping[int, str], name: str) -> LabelSpace:
    """The label space of a network whose classes have these names, by channel. A class whose name
    is not in the table is void; that no class has a category is a ValueError.

    Examples:
        >>> label_space_of_names({0: "road", 1: "car"}, "mine").classes[1].category
        'dynamic'
    """
    if not any(category_of_name(name) in CATEGORIES for name in names.values()):
        first = ", ".join(list(names.values())[:3])
        raise ValueError(
            f"none of the {len(names)} class names of {name} ({first}, ...) has a category; "
            "give --labels-as"
        )
    classes = (
        LabelClass(number, names[number], category_of_name(names[number]) or VOID, None)
        for number in sorted(names)
    )
    return LabelSpace(name, "the network's own class names", tuple(classes))


@cache
def _table() -> dict[str, str]:
    text = resources.files(__package__).joinpath("class_names.yaml").read_text("utf-8")
    document = yaml.safe_load(text)
    assert set(document) == {*CATEGORIES, DYNAMIC, VOID}
    return {name: category for category, names in document.items() for name in names}


def _forms(name: str) -> Iterator[str]:
    """The spellings under which the table may have a name, the most exact first."""
    for synonym in re.split(r"[,;]", name):
        parts = synonym.split("--")
        for first in range(len(parts)):
            words = re.sub(r"[^a-z0-9]+", " ", " ".join(parts[first:]).casefold()).strip()
            yield words
            while words.endswith(("other", "stuff", "merged")) and " " in words:
                words = words.rpartition(" ")[0]
                yield words
