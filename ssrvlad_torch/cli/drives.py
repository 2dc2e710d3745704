"""The references and the queries: two parts of one data set, or two folders."""

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
"""The kinds of files that a method may need of a frame."""

WORDS = {"images": "an image", "labels": "a label map"}


@dataclass(frozen=True)
class Drives:
    """References and queries, and the whole data set that contains them."""

    whole: Dataset
    references: Dataset
    queries: Dataset

    @classmethod
    def open(cls, options: DriveOptions) -> Drives:
        """Opens the data set, and notes what it lacks. A file that may be an image or a label map
        is a label map if the label space is known."""
        drives = cls._of_dataset(options) if options.dataset else cls._of_folders(options)
        names = {t.name for part in (drives.references, drives.queries) for t in part.traverses}
        used = tuple(t for t in drives.whole.traverses if t.name in names)
        for warning in replace(drives.whole, traverses=used).warnings:
            note(warning)
        return drives

    @classmethod
    def _of_dataset(cls, options: DriveOptions) -> Drives:
        assert options.dataset is not None
        layout = None if options.layout == "auto" else options.layout
        whole = _unambiguous(
            open_dataset(options.dataset, layout, options.labels, options.labels_as)
        )
        references, queries = options.references or (), options.queries or ()
        if options.odd_even:
            if queries:
                raise ValueError("--odd-even takes the queries from --references; got --queries")
            both = whole.select(references)
            even = both.with_frames(lambda frames: frames[::2])
            return cls(whole, even, both.with_frames(lambda frames: frames[1::2]))
        return cls(
            whole,
            whole.select(references, None if references else "reference"),
            whole.select(queries, None if queries else "query"),
        )

    @classmethod
    def _of_folders(cls, options: DriveOptions) -> Drives:
        if options.layout or options.odd_even:
            raise ValueError("--layout and --odd-even need the folder of a data set")
        if not options.references or not options.queries:
            raise ValueError(
                "expected the folder of a data set, or folders as --references and --queries"
            )
        references, queries = (
            _joined(
                [open_dataset(path, "folders", options.labels, options.labels_as) for path in paths]
            )
            for paths in (options.references, options.queries)
        )
        return cls(_joined([references, queries]), references, queries)

    def posed(self) -> Drives:
        """The drives without the frames of unknown pose."""
        return self._filter(lambda frame: frame.has_pose, "a pose")

    def complete(self, kinds: Sequence[str]) -> Drives:
        """The drives without the frames that lack a kind of file; notes their number."""
        words = [WORDS[kind] for kind in kinds]
        complete = self._filter(
            lambda frame: all(KINDS[kind](frame) for kind in kinds), " and ".join(words)
        )
        before, after = (sum(1 for _ in drives.frames) for drives in (self, complete))
        if after < before:
            note(
                f"{before - after} of {before} frames are left out: they lack {' or '.join(words)}"
            )
        return complete

    @property
    def frames(self) -> Iterator[Frame]:
        """The references, then the queries."""
        return chain(self.references.frames, self.queries.frames)

    @property
    def _parts(self) -> tuple[tuple[str, Dataset], ...]:
        return ("reference", self.references), ("query", self.queries)

    def _filter(self, has: Callable[[Frame], object], what: str) -> Drives:
        """The drives with only the frames that ``has`` accepts; an error if none is left."""
        references, queries = (
            part.with_frames(lambda frames: filter(has, frames)) for _, part in self._parts
        )
        filtered = replace(self, references=references, queries=queries)
        for name, part in filtered._parts:
            if not any(part.frames):
                raise ValueError(f"no {name} of {part.root} ({part.layout}) has {what}")
        return filtered

    def lacks(self, kind: str) -> str | None:
        """The reason why a method that needs a kind of file cannot run; ``None`` if it can."""
        if kind == "labels" and self.whole.labels_as is None:
            return "it needs label maps and their --labels-as"
        for name, part in self._parts:
            if not any(map(KINDS[kind], part.frames)):
                return f"no {name} of {part.root} ({part.layout}) has {WORDS[kind]}"
        return None


def _unambiguous(dataset: Dataset) -> Dataset:
    """The data set with each file as an image or as a label map, not as both."""

    def decide(frame: Frame) -> Frame:
        if frame.image != frame.label:
            return frame
        return replace(frame, image=None) if dataset.labels_as else replace(frame, label=None)

    return dataset.with_frames(lambda frames: map(decide, frames))


def _joined(parts: Sequence[Dataset]) -> Dataset:
    traverses = tuple(traverse for part in parts for traverse in part.traverses)
    return _unambiguous(replace(parts[0], traverses=traverses, truth=None))
