"""Layout: where a data set has its frames, as patterns of paths that make a `Dataset`."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import NamedTuple

from ..files import natural_key
from ..taxonomy import label_space
from .dataset import Dataset, GroundTruth, LabelsAs, Role, Traverse, files_in, folders_in
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .names import IMAGE_SUFFIXES, absolute_folder
from .poses import Pose

_OWN = ("name", "folder")
"""Fields of a file that are not of its sequence."""
_FIELD = re.compile(r"\{(\w*)(?::([^{}]*))?\}")


class Entry(NamedTuple):
    """A file of a frame, and the texts of the fields of its pattern; ``folder`` is that of its
    folder's name."""

    path: Path
    fields: Mapping[str, str]


def joined(fields: Mapping[str, str]) -> str | None:
    """The sequence named by all fields of the path."""
    return "-".join(text for name, text in fields.items() if name not in _OWN)


@dataclass(frozen=True)
class Layout:
    """The layout of a data set on disk.

    In a pattern ``{city}`` is any text without a slash, ``{camera:left|rear}`` what a regular
    expression matches, and ``{name}`` the name of the frame. A pattern that begins with a folder
    which is a field fits that folder too.

    Attributes:
        name: the name that users give.
        origin: where the data set can be downloaded; empty for custom data.
        expected: description of the folders and files.
        images: patterns of images, without suffixes.
        labels: patterns of label maps, and their label spaces. Of one frame the first counts.
        signs: alternatives, patterns of folders that are all there; by default those of the files.
        encodings: the label spaces are of the same label maps: the first on disk counts. Otherwise
            two are a ValueError.
        sequence: name of the sequence by the fields of a file; ``None`` for what is no frame.
        role: of the sequence, by the same fields.
        poses: poses by the keys of ``frames``, of which a folder and those are given.
        posed_by: what holds the poses, and where it is.
        truth: the definition of a true match for a folder.
    """

    name: str
    origin: str
    expected: str
    images: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)
    signs: tuple[tuple[str, ...], ...] = ()
    encodings: bool = False
    sequence: Callable[[Mapping[str, str]], str | None] = joined
    role: Callable[[Mapping[str, str]], Role | None] = lambda fields: None
    poses: "Callable[[Layout, Path, Frames], Mapping[Key, Pose]]" = lambda *_: {}
    posed_by: str = ""
    truth: Callable[[Path], GroundTruth | None] = lambda root: None

    def recognises(self, root: Path) -> bool:
        """Whether a folder has this layout."""
        files = [(pattern.rpartition("/")[0],) for pattern in (*self.images, *self.labels)]
        return any(all(_folders(root, sign) for sign in signs) for signs in self.signs or files)

    def read(self, root: Path, labels_as: LabelsAs = None) -> Dataset:
        """The data set in a folder; ``labels_as`` is the label space that the user named. Damaged
        files of poses, and files of one name in a folder, are a ValueError that names them."""
        strays = list[Path]()
        images = self.frames(root, self.images, IMAGE_SUFFIXES, strays)
        space, labels = self._labels(root, labels_as, strays)
        frames = labels | images
        poses = self.poses(self, root, frames)
        sequences = dict[str, list[Entry]]()
        for (sequence, _), entry in frames.items():
            sequences.setdefault(sequence, []).append(entry)
        traverses = [
            Traverse.of(
                sequence,
                {name: entry.path for (s, name), entry in images.items() if s == sequence},
                {name: entry.path for (s, name), entry in labels.items() if s == sequence},
                {name: pose for (s, name), pose in poses.items() if s == sequence},
                self.role(fields),
            )
            for sequence, ((_, fields), *_) in sorted(sequences.items(), key=self._place)
        ]
        notes = []
        if self.posed_by and not poses:
            notes.append(f"no frame of {root} has a pose; expected {self.posed_by}")
        if strays:
            notes.append(
                f"{len(strays)} files of {root} are left out, for example {strays[0].name!r}: "
                f"expected {self.expected}"
            )
        truth = self.truth(root)
        return Dataset(self.name, root, tuple(traverses), labels_as or space, truth, tuple(notes))

    def frames(
        self, root: Path, patterns: Iterable[str], suffixes: Sequence[str], strays: list[Path]
    ) -> "dict[Key, Entry]":
        """The files that fit the patterns, the first of each frame. ``strays`` gets those that are
        no frames."""
        frames: dict[Key, Entry] = {}
        for pattern in patterns:
            folders, _, file = pattern.rpartition("/")
            for fields, folder in _folders(root, folders):
                for stem, path in files_in(suffixes, folder).items():
                    if match := _expression(file).fullmatch(stem):
                        entry = Entry(path, fields | match.groupdict() | {"folder": folder.name})
                        if (sequence := self.sequence(entry.fields)) is None:
                            strays.append(path)
                        else:
                            frames.setdefault((sequence, entry.fields["name"]), entry)
        return frames

    def _labels(
        self, root: Path, labels_as: LabelsAs, strays: list[Path]
    ) -> "tuple[str | None, dict[Key, Entry]]":
        """The label space, and the label maps of it."""
        spaces = [*dict.fromkeys(self.labels.values())]
        if self.encodings and labels_as:
            name = label_space(labels_as).name
            spaces = [name if name in spaces else spaces[0]]
        of_space = {
            space: self.frames(
                root, (p for p in self.labels if self.labels[p] == space), LABEL_SUFFIXES, strays
            )
            for space in spaces
        }
        there = [space for space in spaces if of_space[space]]
        if len(there) > 1 and not self.encodings:
            names = " and ".join(sorted(there))
            raise ValueError(f"{root} holds label maps of {names}; expected one layout only")
        space = next(iter(there or spaces), None)
        return space, of_space[space] if space else {}

    def _place(self, item: tuple[str, list[Entry]]) -> tuple[object, ...]:
        """Sequences go by the first folder, then references first, then by name."""
        sequence, ((_, fields), *_) = item
        first = next((text for name, text in fields.items() if name not in _OWN), "")
        return natural_key(first), self.role(fields) != "reference", natural_key(sequence)


Key = tuple[str, str]
"""The sequence and the name of a frame."""
Frames = Mapping[Key, Entry]


def by_file(
    pattern: str, suffix: str, read: Callable[[Path], Pose]
) -> Callable[[Layout, Path, Frames], Mapping[Key, Pose]]:
    """Poses of which each is in a file of its own, as `Layout.poses`."""

    def poses(layout: Layout, root: Path, frames: Frames) -> Mapping[Key, Pose]:
        files = layout.frames(root, [pattern], [suffix], [])
        return {key: read(entry.path) for key, entry in files.items() if key in frames}

    return poses


def _folders(root: Path, pattern: str) -> list[tuple[dict[str, str], Path]]:
    """The folders that fit a pattern, with the texts of its fields: from ``root`` itself as the
    first of the pattern, or, if there are none, from those in it."""
    first, _, rest = pattern.partition("/")
    itself = absolute_folder(root).name
    match = _expression(first).fullmatch(itself) if rest and _FIELD.fullmatch(first) else None
    inside = [(match.groupdict() | f, folder) for f, folder in _below(root, rest)] if match else []
    return inside or list(_below(root, pattern))


def _below(root: Path, pattern: str) -> Iterator[tuple[dict[str, str], Path]]:
    if not pattern:
        yield {}, root
        return
    first, _, rest = pattern.partition("/")
    for folder in folders_in(root):
        if match := _expression(first).fullmatch(folder.name):
            for fields, last in _below(folder, rest):
                yield match.groupdict() | fields, last


@cache
def _expression(pattern: str) -> re.Pattern[str]:
    """The regular expression of a part of a pattern."""
    parts, end = list[str](), 0
    for match in _FIELD.finditer(pattern):
        name = f"?P<{match[1]}>" if match[1] else "?:"
        parts += [re.escape(pattern[end : match.start()]), f"({name}{match[2] or '.+'})"]
        end = match.end()
    return re.compile("".join([*parts, re.escape(pattern[end:])]))
