"""The references and the queries of one data set, or of two folders."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from ..datasets.dataset import Dataset, Frame
from ..datasets.layouts import open_dataset
from .output import note

KINDS: dict[str, Callable[[Frame], Path | None]] = {
    "images": lambda frame: frame.image,
    "labels": lambda frame: frame.label,
}
"""What a method may need of a frame, and where it is."""

WORDS = {"images": "an image", "labels": "a label map"}


@dataclass(frozen=True)
class Naming:
    """What are references and what are queries: sequences or folders, or, of a drive against
    itself, the even frames and the odd ones."""

    references: Sequence[str]
    queries: Sequence[str]
    odd_even: bool


@dataclass(frozen=True)
class Labels:
    """Label maps in place of the data set's own, if any, and the label space."""

    folder: Path | None
    labels_as: str | None


@dataclass(frozen=True)
class Drives:
    """References and queries, and all that the data set has."""

    whole: Dataset
    references: Dataset
    queries: Dataset

    @classmethod
    def open(
        cls, folder: Path | None, layout: str | None, naming: Naming, labels: Labels
    ) -> Drives:
        """Opens a data set; what it lacks is noted. A file that may be an image or a label map is
        a label map if the label space is known.

        Raises:
            ValueError: the options do not fit together, or the data set does not fit them.
        """
        if folder is None:
            drives = cls._of_folders(layout, naming, labels)
        else:
            drives = cls._of_dataset(folder, layout, naming, labels)
        names = {t.name for part in (drives.references, drives.queries) for t in part.traverses}
        used = tuple(t for t in drives.whole.traverses if t.name in names)
        for warning in replace(drives.whole, traverses=used).warnings:
            note(warning)
        return drives

    @classmethod
    def _of_dataset(
        cls, folder: Path, layout: str | None, naming: Naming, labels: Labels
    ) -> Drives:
        name = None if layout == "auto" else layout
        whole = _told_apart(open_dataset(folder, name, labels.folder, labels.labels_as))
        if naming.odd_even:
            if naming.queries:
                raise ValueError("--odd-even takes both of --references; expected no --queries")
            both = whole.select(naming.references)
            return cls(whole, _every_other(both, 0), _every_other(both, 1))
        references = whole.select(naming.references, None if naming.references else "reference")
        queries = whole.select(naming.queries, None if naming.queries else "query")
        return cls(whole, references, queries)

    @classmethod
    def _of_folders(cls, layout: str | None, naming: Naming, labels: Labels) -> Drives:
        if layout or naming.odd_even:
            raise ValueError("--layout and --odd-even want the folder of a data set")
        if not naming.references or not naming.queries:
            raise ValueError(
                "expected the folder of a data set, or folders as --references and --queries"
            )
        references, queries = (
            _joined([open_dataset(path, "folders", labels.folder, labels.labels_as) for path in p])
            for p in (naming.references, naming.queries)
        )
        return cls(_joined([references, queries]), references, queries)

    def posed(self) -> Drives:
        """The same without the frames whose pose is not known.

        Raises:
            ValueError: no frame is left.
        """
        return self._keep(lambda frame: frame.has_pose, "a pose")

    def complete(self, kinds: Sequence[str]) -> Drives:
        """The same without the frames that lack a kind; how many they are is noted.

        Raises:
            ValueError: no frame is left.
        """
        words = [WORDS[kind] for kind in kinds]
        complete = " and ".join(words)
        kept = self._keep(lambda frame: all(KINDS[kind](frame) for kind in kinds), complete)
        before, after = (sum(1 for _ in drives.frames) for drives in (self, kept))
        if after < before:
            note(
                f"{before - after} of {before} frames are left out: they lack {' or '.join(words)}"
            )
        return kept

    @property
    def frames(self) -> Iterator[Frame]:
        """The references, then the queries."""
        return chain(self.references.frames, self.queries.frames)

    @property
    def _parts(self) -> tuple[tuple[str, Dataset], ...]:
        return ("reference", self.references), ("query", self.queries)

    def _keep(self, wanted: Callable[[Frame], object], what: str) -> Drives:
        references, queries = (_filtered(part, wanted) for _, part in self._parts)
        kept = replace(self, references=references, queries=queries)
        for name, part in kept._parts:
            if not any(part.frames):
                raise ValueError(f"no {name} of {part.root} ({part.layout}) has {what}")
        return kept

    def lacks(self, kind: str) -> str | None:
        """Why nothing that needs this kind of frame can be done, if so."""
        if kind == "labels" and self.whole.labels_as is None:
            return "it needs label maps and their --labels-as"
        for name, part in self._parts:
            if not any(map(KINDS[kind], part.frames)):
                return f"no {name} of {part.root} ({part.layout}) has {WORDS[kind]}"
        return None


def _told_apart(dataset: Dataset) -> Dataset:
    def decide(frame: Frame) -> Frame:
        if frame.image != frame.label:
            return frame
        return replace(frame, image=None) if dataset.labels_as else replace(frame, label=None)

    traverses = tuple(replace(t, frames=tuple(map(decide, t.frames))) for t in dataset.traverses)
    return replace(dataset, traverses=traverses)


def _every_other(dataset: Dataset, start: int) -> Dataset:
    traverses = tuple(replace(t, frames=t.frames[start::2]) for t in dataset.traverses)
    return replace(dataset, traverses=traverses)


def _filtered(dataset: Dataset, wanted: Callable[[Frame], object]) -> Dataset:
    traverses = tuple(replace(t, frames=tuple(filter(wanted, t.frames))) for t in dataset.traverses)
    return replace(dataset, traverses=traverses)


def _joined(parts: Sequence[Dataset]) -> Dataset:
    traverses = tuple(traverse for part in parts for traverse in part.traverses)
    return _told_apart(replace(parts[0], traverses=traverses, truth=None))
