"""``ssrvlad labels``."""

from __future__ import annotations

from ...untrusted import read_yaml
from ..options import Json, argument
from ..output import print_json, print_table, say


def labels(
    *,
    name: str = argument("A label space: a name or a .yaml file; or a network, as --segmenter."),
    as_json: Json = False,
) -> None:
    """Print the category of each class. A class has none if it moves, if no category fits, or if
    its name is unknown.

    Example: ssrvlad labels cityscapes-trainids
    """
    from ...class_names import category_of_name
    from ...segmentation.segmenter import Segmenter
    from ...taxonomy import CATEGORIES, label_space, label_space_names

    own = name not in label_space_names() and _is_network(name)
    space = Segmenter.load(name).label_space if own else label_space(name)
    rows = []
    for label in space.classes:
        unknown = own and category_of_name(label.name) is None
        rows.append((label.id, label.name, "unknown name" if unknown else label.category))
    if as_json:
        classes = [{"id": n, "name": each, "category": kind} for n, each, kind in rows]
        print_json({"name": space.name, "classes": classes})
        return
    from rich.table import Table

    table = Table("id", "name", "category")
    for number, each, kind in rows:
        table.add_row(str(number), each, kind)
    print_table(table)
    out = [each for _, each, kind in rows if kind not in CATEGORIES]
    say(
        f"{space.name}: {len(rows) - len(out)} of {len(rows)} classes have a category; left out: "
        f"{', '.join(out) or 'none'}"
    )


def _is_network(name: str) -> bool:
    """Whether a name is one of a network, and not of a label space: a plain word, or a YAML file
    that tells of no network."""
    from pathlib import Path

    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        return ":" in name or bool(path.suffix) or path.exists()
    document = read_yaml(name) if path.is_file() else None
    return isinstance(document, dict) and "network" in document
