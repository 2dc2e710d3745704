"""``ssrvlad labels``."""

from pathlib import Path

from ...files import read_yaml
from ..options import NETWORK, Json, argument
from ..output import print_json, print_table, say


def labels(
    *,
    name: str = argument(
        f"Label space: a name or a .yaml file; or segmentation network: {NETWORK}"
    ),
    as_json: Json = False,
) -> None:
    """Print the category of each class of a label space. A class has no category if it moves, if
    none fits, or if its name is unknown. Of a network, also print which activations are features.

    Example: ssrvlad labels cityscapes-trainids
    """
    from ...segmentation.class_names import category_of_name
    from ...segmentation.segmenter import Segmenter
    from ...taxonomy import CATEGORIES, label_space, label_space_names

    of_network = name not in label_space_names() and _is_network(name)
    segmenter = Segmenter.load(name) if of_network else None
    space = segmenter.label_space if segmenter else label_space(name)
    try:
        features, problem = segmenter and segmenter.features, ""
    except ValueError as error:
        features, problem = None, str(error)
    rows = []
    for label in space.classes:
        unknown = segmenter and category_of_name(label.name) is None
        rows.append((label.id, label.name, "unknown name" if unknown else label.category))
    if as_json:
        classes = [dict(zip(("id", "name", "category"), row, strict=True)) for row in rows]
        names = features and features.names
        print_json({"name": space.name, "classes": classes, "features": names})
        return
    from rich.table import Table

    table = Table("id", "name", "category")
    for row in rows:
        table.add_row(*map(str, row))
    print_table(table)
    out = [class_name for _, class_name, category in rows if category not in CATEGORIES]
    say(
        f"{space.name}: {len(rows) - len(out)} of {len(rows)} classes have a category; left out: "
        f"{', '.join(out) or 'none'}"
    )
    if segmenter:
        taken = ", ".join(map(str, features.activations)) if features else f"none: {problem}"
        say(f"features: {taken}")


def _is_network(name: str) -> bool:
    """Whether a name belongs to a network: a YAML file with the key ``network``, or another name
    that has a colon or a suffix, or is a path that exists."""
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        return ":" in name or bool(path.suffix) or path.exists()
    document = read_yaml(name) if path.is_file() else None
    return isinstance(document, dict) and "network" in document
