"""The references and the queries of one data set, or of two folders."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from ..datasets.dataset import Dataset, Frame
from ..datasets.layouts import open_dataset
from .options import DriveOptions
from .output import note

KINDS: dict[str, Callable[[Frame], Path | None]] = {
    "images": lambda frame: frame.image,
    "labels": lambda frame: frame.label,
}
"""What a method may need of a frame, and where it is."""

WORDS = {"images": "an image", "labels": "a label map"}


@dataclass(frozen=True)
class Drives:
    """References and queries, and the whole data set that they are from."""

    whole: Dataset
    references: Dataset
    queries: Dataset

    @classmethod
    def open(cls, given: DriveOptions) -> Drives:
        """Opens a data set; what it lacks is noted. A file that may be an image or a label map is a
        label map if the label space is known."""
        drives = cls._of_dataset(given.dataset, given) if given.dataset else cls._of_folders(given)
        names = {t.name for part in (drives.references, drives.queries) for t in part.traverses}
        used = tuple(t for t in drives.whole.traverses if t.name in names)
        for warning in replace(drives.whole, traverses=used).warnings:
            note(warning)
        return drives

    @classmethod
    def _of_dataset(cls, folder: Path, given: DriveOptions) -> Drives:
        layout = None if given.layout == "auto" else given.layout
        whole = _told_apart(open_dataset(folder, layout, given.labels, given.labels_as))
        references, queries = given.references or (), given.queries or ()
        if given.odd_even:
            if queries:
                raise ValueError("--odd-even takes both of --references; expected no --queries")
            both = whole.select(references)
            even = both.with_frames(lambda frames: frames[::2])
            return cls(whole, even, both.with_frames(lambda frames: frames[1::2]))
        return cls(
            whole,
            whole.select(references, None if references else "reference"),
            whole.select(queries, None if queries else "query"),
        )

    @classmethod
    def _of_folders(cls, given: DriveOptions) -> Drives:
        if given.layout or given.odd_even:
            raise ValueError("--layout and --odd-even want the folder of a data set")
        if not given.references or not given.queries:
            raise ValueError(
                "expected the folder of a data set, or folders as --references and --queries"
            )
        references, queries = (
            _joined(
                [open_dataset(path, "folders", given.labels, given.labels_as) for path in paths]
            )
            for paths in (given.references, given.queries)
        )
        return cls(_joined([references, queries]), references, queries)

    def posed(self) -> Drives:
        """The same without the frames of unknown pose."""
        return self._keep(lambda frame: frame.has_pose, "a pose")

    def complete(self, kinds: Sequence[str]) -> Drives:
        """The same without the frames that lack a kind; notes how many these are."""
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
        references, queries = (
            part.with_frames(lambda frames: filter(wanted, frames)) for _, part in self._parts
        )
        kept = replace(self, references=references, queries=queries)
        for name, part in kept._parts:
            if not any(part.frames):
                raise ValueError(f"no {name} of {part.root} ({part.layout}) has {what}")
        return kept

    def lacks(self, kind: str) -> str | None:
        """Why a method that needs this kind of file cannot run; ``None`` if it can."""
        if kind == "labels" and self.whole.labels_as is None:
            return "it needs label maps and their --labels-as"
        for name, part in self._parts:
            if not any(map(KINDS[kind], part.frames)):
                return f"no {name} of {part.root} ({part.layout}) has {WORDS[kind]}"
        return None


def _told_apart(dataset: Dataset) -> Dataset:
    """A file that could be an image or a label map is one of them only."""

    def decide(frame: Frame) -> Frame:
        if frame.image != frame.label:
            return frame
        return replace(frame, image=None) if dataset.labels_as else replace(frame, label=None)

    return dataset.with_frames(lambda frames: map(decide, frames))


def _joined(parts: Sequence[Dataset]) -> Dataset:
    traverses = tuple(traverse for part in parts for traverse in part.traverses)
    return _told_apart(replace(parts[0], traverses=traverses, truth=None))
