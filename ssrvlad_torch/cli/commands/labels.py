"""``ssrvlad labels``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...encoding.selection import NETWORK
from ...files import read_yaml
from ..options import Json, argument, option, switch
from ..output import print_json, print_table, say

if TYPE_CHECKING:
    from ...taxonomy import LabelSpace


def labels(
    *,
    name: str = argument(
        f"Label space: a name or a .yaml file; or segmentation network: {NETWORK}"
    ),
    labels_as: str | None = option(
        "Of a network: the label space of its classes. Default: the one of its YAML file, else the "
        "one of its class names."
    ),
    with_activations: bool = switch(
        "--all",
        "Of a network: print all activations with channels and strides, and mark those that are "
        "features. A YAML file chooses others by their names, features: [NAME].",
    ),
    as_json: Json = False,
) -> None:
    """Print the category of each class of a label space. A class has no category if it moves, if
    none fits, or if its name is unknown. Of a network, also print which activations are features.

    Example: ssrvlad labels cityscapes-trainids
    Example: ssrvlad labels seg.yaml --labels-as cityscapes-trainids --all
    """
    from ...segmentation.networks import AUTO
    from ...segmentation.segmenter import Segmenter
    from ...taxonomy import label_space, label_space_names

    of_network = name not in label_space_names() and _is_network(name)
    if not of_network and (labels_as or with_activations):
        raise ValueError(f"{name} is a label space; --labels-as and --all are for networks")
    segmenter = Segmenter.load(name, labels_as or AUTO) if of_network else None
    space = segmenter.label_space if segmenter else label_space(name)
    try:
        features, problem = segmenter and segmenter.features, ""
    except ValueError as error:
        features, problem = None, str(error)
    rows = _classes(space, of_names=bool(segmenter and not labels_as))
    names = features.names if features else []
    activations = None
    if segmenter and with_activations:
        listed = segmenter.activations()
        activations = [{**act._asdict(), "chosen": act.name in names} for act in listed]
    if as_json:
        classes = [dict(zip(("id", "name", "category"), row, strict=True)) for row in rows]
        report = {"name": space.name, "classes": classes, "features": features and names}
        print_json(report | ({"activations": activations} if with_activations else {}))
        return
    _print(space.name, rows, activations)
    if segmenter:
        activations_line = (
            ", ".join(map(str, features.activations)) if features else f"none: {problem}"
        )
        say(f"features: {activations_line}")


def _print(
    name: str, rows: list[tuple[int, str, str]], activations: list[dict[str, Any]] | None
) -> None:
    from ...taxonomy import CATEGORIES

    print_table(("id", "name", "category"), rows)
    out = [class_name for _, class_name, category in rows if category not in CATEGORIES]
    have = f"{name}: {len(rows) - len(out)} of {len(rows)} classes have a category"
    say(f"{have}; left out: {', '.join(out) or 'none'}")
    if activations is not None:
        print_table(("activation", "channels", "height", "width", "stride", ""), [
            (act["name"], *act["shape"][1:], f"{act['stride']:.3g}", "features" * act["chosen"])
            for act in activations
        ])  # fmt: skip


def _classes(space: LabelSpace, of_names: bool) -> list[tuple[int, str, str]]:
    """Id, name and category of each class; ``of_names``: the names of the classes decide."""
    from ...segmentation.class_names import category_of_name

    return [
        (label.id, label.name, "unknown name" if unknown else label.category)
        for label in space.classes
        for unknown in [of_names and category_of_name(label.name) is None]
    ]


def _is_network(name: str) -> bool:
    """Whether a name belongs to a network: a YAML file with the key ``network``, or without a name
    and a source, which a label space has, or another name that has a colon or a suffix, or is a
    path that exists."""
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        return ":" in name or bool(path.suffix) or path.exists()
    document = read_yaml(name) if path.is_file() else None
    of_space = {"name", "source"}
    return isinstance(document, dict) and ("network" in document or not of_space & document.keys())
