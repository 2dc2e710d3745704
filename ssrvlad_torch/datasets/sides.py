"""The two sides of a comparison, references and queries, of a data set or of folders."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .dataset import Dataset, DatasetFrame, LabelsAs, Role
from .layouts import open_dataset

ROLES: tuple[Role, Role] = ("reference", "query")


def open_sides(
    note: Callable[[str], object],
    *,
    dataset: Path | None,
    references: Sequence[str] | None,
    queries: Sequence[str] | None,
    layout: str | None,
    labels: Path | None,
    labels_as: LabelsAs,
) -> Dataset:
    """The frames of a data set in their roles: of its sequences, by default by declared roles; or,
    without ``dataset``, of folders. ``note`` gets what is missing; see `open_dataset`. Arguments
    that do not go together are a ValueError."""
    names = dict(zip(ROLES, (references or (), queries or ()), strict=True))
    frames = list[DatasetFrame]()
    if dataset:
        whole = open_dataset(dataset, layout, labels, labels_as)
        for role, patterns in names.items():
            side = whole.select(patterns, None if patterns else role)
            frames += [replace(frame, role=role) for frame in side.frames]
    elif layout:
        raise ValueError("--layout needs the folder of a data set")
    elif not all(names.values()):
        raise ValueError(
            "expected the folder of a data set, or folders as --references and --queries"
        )
    else:
        roots = dict[str, Path]()
        for role, path in ((role, path) for role, paths in names.items() for path in paths):
            whole = replace(open_dataset(path, "folders", labels, labels_as), truth=None)
            for sequence in whole.sequences:
                if (earlier := roots.setdefault(sequence, whole.root)) is not whole.root:
                    raise ValueError(
                        f"{earlier} and {path} both have a sequence {sequence!r}; expected two "
                        "folders of different names"
                    )
            frames += [replace(frame, role=role) for frame in whole.frames]
    unused: dict[str, Any] = {"image": None} if whole.labels_as else {"label": None}
    used = (replace(f, **unused) if f.image == f.label else f for f in frames)
    sides = replace(whole, frames=tuple(used))
    for warning in sides.warnings:
        note(warning)
    return sides
