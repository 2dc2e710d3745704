"""The references and the queries of a comparison: parts of one data set, or folders."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

from .dataset import Dataset, DatasetFrame, LabelsAs, Role
from .layouts import open_dataset
from .names import absolute

ROLES: tuple[Role, Role] = ("reference", "query")


def open_sides(
    note: Callable[[str], object],
    *,
    dataset: Path | None,
    references: Sequence[str] | None,
    queries: Sequence[str] | None,
    odd_even: bool,
    layout: str | None,
    labels: Path | None,
    labels_as: LabelsAs,
) -> Dataset:
    """The frames of a data set, or, without ``dataset``, of folders, each in the role in which it
    is used. A file that may be an image or a label map is a label map if the label space is known.

    Args:
        note: gets what the data set lacks.
        dataset: folder of the data set.
        references, queries: sequences of the data set, by default in their declared roles, or
            folders.
        odd_even: even frames of ``references`` are references, odd ones queries.
        layout, labels, labels_as: see `open_dataset`.

    Raises:
        ValueError: arguments do not go together, or as for `open_dataset`.
    """
    names = references or (), queries or ()
    frames = list[DatasetFrame]()
    if dataset:
        whole = open_dataset(dataset, layout, labels, labels_as)
        if odd_even and queries:
            raise ValueError("--odd-even takes the queries from --references; got --queries")
        if odd_even:
            alternating = whole.select(names[0]).frames
            for _, sequence in groupby(alternating, key=lambda frame: frame.sequence):
                frames += [replace(f, role=ROLES[n % 2]) for n, f in enumerate(sequence)]
        else:
            for role, patterns in zip(ROLES, names, strict=True):
                side = whole.select(patterns, None if patterns else role)
                frames += [replace(frame, role=role) for frame in side.frames]
    elif layout or odd_even:
        raise ValueError("--layout and --odd-even need the folder of a data set")
    elif not all(names):
        raise ValueError(
            "expected the folder of a data set, or folders as --references and --queries"
        )
    else:
        roots = dict[str, Path]()
        for role, paths in zip(ROLES, names, strict=True):
            for path in paths:
                whole = replace(open_dataset(path, "folders", labels, labels_as), truth=None)
                _require_other_names(whole, roots)
                frames += [replace(frame, role=role) for frame in whole.frames]
    unused: dict[str, Any] = {"image": None} if whole.labels_as else {"label": None}
    used = (replace(f, **unused) if f.image == f.label else f for f in frames)
    sides = replace(whole, frames=tuple(used))
    for warning in sides.warnings:
        note(warning)
    return sides


def _require_other_names(folder: Dataset, roots: dict[str, Path]) -> None:
    """Raises a ValueError if a sequence of a folder has the name of one before; ``roots`` gets
    the folders by their sequences."""
    for sequence in folder.sequences:
        if (earlier := roots.setdefault(sequence, folder.root)) is not folder.root:
            if absolute(earlier) == absolute(folder.root):
                raise ValueError(f"{earlier} is given twice; expected different folders")
            raise ValueError(
                f"{earlier} and {folder.root} both have a sequence {sequence!r}; expected another "
                "name of one of the folders"
            )
