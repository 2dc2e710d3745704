"""The references and the queries: two parts of one data set, or two folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from .dataset import Dataset, DatasetFrame, LabelsAs
from .layouts import open_dataset
from .names import absolute

KINDS: dict[str, tuple[Callable[[DatasetFrame], Path | None], str]] = {
    "images": (lambda frame: frame.image, "an image"),
    "labels": (lambda frame: frame.label, "a label map"),
}
"""The kinds of files that a method may need of a frame, each also in words."""


@dataclass(frozen=True)
class Drives:
    """References and queries, and the whole data set that contains them."""

    whole: Dataset
    references: Dataset
    queries: Dataset

    @classmethod
    def open(
        cls,
        note: Callable[[str], object],
        *,
        dataset: Path | None,
        references: Sequence[str] | None,
        queries: Sequence[str] | None,
        odd_even: bool,
        layout: str | None,
        labels: Path | None,
        labels_as: LabelsAs,
    ) -> Drives:
        """Opens a data set, or, without ``dataset``, folders as references and queries. A file that
        may be an image or a label map is a label map if the label space is known. With
        ``odd_even``, even frames of ``references`` are references, odd ones queries. For
        ``layout``, ``labels``, ``labels_as`` and errors see `open_dataset`; arguments that do not
        go together are a ValueError too. ``note`` gets what the data set lacks."""
        names, asked = (references or (), queries or ()), (labels, labels_as)
        if dataset:
            whole = _unambiguous(open_dataset(dataset, layout, *asked))
            if odd_even and queries:
                raise ValueError("--odd-even takes the queries from --references; got --queries")
            if odd_even:
                both = whole.select(names[0])
                even = both.with_frames(lambda frames: frames[::2])
                sides = [even, both.with_frames(lambda frames: frames[1::2])]
            else:
                sides = [
                    whole.select(names[0], None if names[0] else "reference"),
                    whole.select(names[1], None if names[1] else "query"),
                ]
        elif layout or odd_even:
            raise ValueError("--layout and --odd-even need the folder of a data set")
        elif not all(names):
            raise ValueError(
                "expected the folder of a data set, or folders as --references and --queries"
            )
        else:
            folders = [[open_dataset(path, "folders", *asked) for path in paths] for paths in names]
            whole, sides = _joined([*chain(*folders)]), list(map(_joined, folders))
        used = {traverse.name for side in sides for traverse in side.traverses}
        traverses = tuple(t for t in whole.traverses if t.name in used)
        for warning in replace(whole, traverses=traverses).warnings:
            note(warning)
        return cls(whole, *sides)

    def posed(self) -> Drives:
        """The drives without the frames of unknown pose."""
        return self._filter(lambda frame: frame.has_pose, "a pose")

    def complete(self, kinds: Sequence[str], note: Callable[[str], object]) -> Drives:
        """The drives without the frames that lack a kind of file; ``note`` gets their number."""
        if not kinds:
            return self
        has, words = zip(*(KINDS[kind] for kind in kinds), strict=True)
        complete = self._filter(lambda frame: all(h(frame) for h in has), " and ".join(words))
        before, after = (
            sum(len(t.frames) for side in (d.references, d.queries) for t in side.traverses)
            for d in (self, complete)
        )
        if after < before:
            lacking = f"they lack {' or '.join(words)}"
            note(f"{before - after} of {before} frames are left out: {lacking}")
        return complete

    def lacks(self, kind: str) -> str | None:
        """The reason why a method that needs a kind of file cannot run; ``None`` if it can."""
        if kind == "labels" and self.whole.labels_as is None:
            return "it needs label maps and their --labels-as"
        try:
            self._filter(*KINDS[kind])
        except ValueError as error:
            return str(error)
        return None

    def _filter(self, has: Callable[[DatasetFrame], object], what: str) -> Drives:
        """The drives with only the frames that ``has`` accepts; an error if none is left."""
        sides = []
        for name, side in (("reference", self.references), ("query", self.queries)):
            sides.append(side.with_frames(lambda frames: filter(has, frames)))
            if not any(sides[-1].frames):
                raise ValueError(f"no {name} of {side.root} ({side.layout}) has {what}")
        return Drives(self.whole, *sides)


def _unambiguous(dataset: Dataset) -> Dataset:
    """The data set with each file as an image or as a label map, not as both."""
    other: dict[str, Any] = {"image" if dataset.labels_as else "label": None}
    return dataset.with_frames(
        lambda frames: (replace(f, **other) if f.image == f.label else f for f in frames)
    )


def _joined(sides: Sequence[Dataset]) -> Dataset:
    roots = dict[str, Path]()
    for side in sides:
        for traverse in side.traverses:
            if (other := roots.setdefault(traverse.name, side.root)) is not side.root:
                if absolute(other) == absolute(side.root):
                    raise ValueError(f"{other} is given twice; expected different folders")
                raise ValueError(
                    f"{other} and {side.root} both have a sequence {traverse.name!r}; expected "
                    "another name of one of the folders"
                )
    traverses = tuple(traverse for side in sides for traverse in side.traverses)
    return _unambiguous(replace(sides[0], traverses=traverses, truth=None))
