"""A data set on disk: sequences of frames, which of them are queries, and what counts as right."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

from natsort import natsorted

from ..taxonomy import label_space
from .frame_files import FrameFile, every_nth
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .poses import UNKNOWN, Pose

Role = Literal["reference", "query"]


@dataclass(frozen=True)
class Frame:
    """One picture of a data set.

    Attributes:
        sequence, name: the frame's id is ``<sequence>/<name>``.
        image: the photo, if it is on disk.
        label: its label map, if there is one.
        pose: metres and radians, NaN where unknown.
    """

    sequence: str
    name: str
    image: Path | None = None
    label: Path | None = None
    pose: Pose = UNKNOWN

    @property
    def frame(self) -> str:
        """The frame's id."""
        return f"{self.sequence}/{self.name}"

    @property
    def has_pose(self) -> bool:
        """Whether it is known where the frame was taken."""
        return not (math.isnan(self.pose.x) or math.isnan(self.pose.y))


class GroundTruth(NamedTuple):
    """When a reference shows the place of a query; one of the three is given, as in ``evaluate``.

    Attributes:
        source: who defines it.
        file: a file of true matches.
        metres: largest distance on the ground.
        frames: largest distance in frames along the drive.
    """

    source: str
    file: Path | None = None
    metres: float | None = None
    frames: int | None = None


@dataclass(frozen=True)
class Traverse:
    """One drive along a route with one camera.

    Attributes:
        name: the sequence of its frames.
        frames: in natural order of their names.
        role: as the data set declares it, or ``None``.
    """

    name: str
    frames: tuple[Frame, ...]
    role: Role | None = None

    @classmethod
    def of(
        cls,
        name: str,
        images: Mapping[str, Path],
        labels: Mapping[str, Path],
        poses: Mapping[str, Pose],
        role: Role | None = None,
    ) -> Traverse:
        """A traverse of all frames that have an image or a label map, by their names."""
        frames = tuple(
            Frame(name, key, images.get(key), labels.get(key), poses.get(key, UNKNOWN))
            for key in natsorted(sorted({*images, *labels}))
        )
        return cls(name, frames, role)


@dataclass(frozen=True)
class Dataset:
    """Traverses, and what is known of them. Made by `open_dataset`.

    Attributes:
        layout: name of its layout.
        root: its folder.
        traverses: no two of one name.
        labels_as: label space of the label maps, ``None`` if unknown or without label maps.
        truth: what the data set counts as a true match, or ``None``.
        notes: what the layout has and this copy lacks, a line each.
    """

    layout: str
    root: Path
    traverses: tuple[Traverse, ...]
    labels_as: str | None = None
    truth: GroundTruth | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        counts = Counter(traverse.name for traverse in self.traverses)
        repeated = [name for name, count in counts.items() if count > 1]
        if repeated:
            raise ValueError(f"{self.root} has more than one sequence {repeated[0]!r}")

    @property
    def frames(self) -> Iterator[Frame]:
        """All frames, one traverse after another."""
        return (frame for traverse in self.traverses for frame in traverse.frames)

    @property
    def warnings(self) -> list[str]:
        """What is missing, a line each: the notes, and how many frames lack a file or a pose."""
        frames = list(self.frames)
        lacking = {
            "image": [frame for frame in frames if frame.image is None],
            "label map": [frame for frame in frames if frame.label is None],
            "pose": [frame for frame in frames if not frame.has_pose],
        }
        return [
            *self.notes,
            *(
                f"{len(without)} of {len(frames)} frames have no {what}, the first is "
                f"{without[0].frame}"
                for what, without in lacking.items()
                if 0 < len(without) < len(frames)
            ),
        ]

    def select(self, patterns: Sequence[str] = (), role: Role | None = None) -> Dataset:
        """The same data set with some of its traverses.

        Args:
            patterns: names of sequences, where ``*`` is any text and ``?`` any letter; without,
                all.
            role: only traverses that the data set declares to be this.

        Raises:
            ValueError: a pattern matches no sequence, or none has the role.
        """
        names = [traverse.name for traverse in self.traverses]
        chosen = set() if patterns else set(names)
        for pattern in patterns:
            found = [name for name in names if fnmatchcase(name, pattern)]
            if not found:
                has = shortened(names)
                raise ValueError(f"{self.root} has no sequence {pattern!r}; it has {has}")
            chosen.update(found)
        kept = [traverse for traverse in self.traverses if traverse.name in chosen]
        if role and not any(traverse.role == role for traverse in kept):
            several = shortened([traverse.name for traverse in kept])
            raise ValueError(f"{self.root} does not say which of {several} is a {role}; name it")
        return replace(self, traverses=tuple(t for t in kept if role in (None, t.role)))

    def with_frames(self, change: Callable[[tuple[Frame, ...]], Iterable[Frame]]) -> Dataset:
        """The same data set with other frames in each traverse."""
        traverses = tuple(replace(t, frames=tuple(change(t.frames))) for t in self.traverses)
        return replace(self, traverses=traverses)

    def posed(self) -> Dataset:
        """The same data set without frames of unknown pose; none left is a ValueError."""
        found = self.with_frames(lambda frames: (frame for frame in frames if frame.has_pose))
        if not any(found.frames):
            raise ValueError(f"no frame of {self.root} ({self.layout}) has a pose")
        return found

    def with_labels(self, folder: str | Path, labels_as: str) -> Dataset:
        """The same data set with other label maps, for example a network's predictions.

        A frame's label map has the name of the frame or of its image and lies in
        ``folder/<sequence>``, in ``folder/<where the image lies under the root>``, in the folder of
        this name beside that of the image (``0016E5/images`` and ``0016E5/predicted``), or in
        ``folder`` itself if no two frames have one name.

        Args:
            folder: where the label maps are.
            labels_as: their label space, a name or a ``.yaml`` file.

        Raises:
            ValueError: no frame has a label map there, or there is no such label space.
        """
        label_space(labels_as)
        find = _label_finder(self, Path(folder))
        found = self.with_frames(lambda frames: (replace(f, label=find(f)) for f in frames))
        found = replace(found, labels_as=labels_as)
        if all(frame.label is None for frame in found.frames):
            frame = next(self.frames)
            raise ValueError(
                f"{folder} holds no label map of a frame of {self.root}; expected, for example, "
                f"{Path(folder) / frame.sequence / frame.name}.png"
            )
        return found

    def label_files(self, every: int = 1, start: int = 0) -> list[FrameFile]:
        """The label maps, as `encode` takes them; for ``every`` and ``start`` see `find_frames`.

        Raises:
            ValueError: there is none, or ``every`` or ``start`` is out of range.
        """
        missing = "no label maps; segment its images and give the folder of the results and their "
        return self._files(lambda frame: frame.label, missing + "label space", every, start)

    def image_files(self, every: int = 1, start: int = 0) -> list[FrameFile]:
        """The images, as a segmenter takes them; see `label_files`."""
        return self._files(lambda frame: frame.image, "no images", every, start)

    def _files(
        self, path: Callable[[Frame], Path | None], missing: str, every: int, start: int
    ) -> list[FrameFile]:
        if not any(map(path, self.frames)):
            raise ValueError(f"{self.root} ({self.layout}) has {missing}")
        kept = []
        for traverse in self.traverses:
            files = [
                FrameFile(frame.sequence, frame.name, place, None, frame.pose)
                for frame in traverse.frames
                if (place := path(frame)) is not None
            ]
            kept += every_nth(files, every, start)
        if not kept:
            raise ValueError(f"no sequence of {self.root} has a frame {start}")
        return kept


class Layout(NamedTuple):
    """How a data set lies on disk.

    Attributes:
        name: as users give it.
        origin: where to get the data set; empty for no data set in particular.
        expected: the folders and files that it is recognised by, in words.
        recognises: gives something true for a folder that is laid out so.
        read: the data set in a folder; the second argument is the label space that the user gave,
            if any. A damaged file is a ValueError that names it.
    """

    name: str
    origin: str
    expected: str
    recognises: Callable[[Path], object]
    read: Callable[[Path, str | None], Dataset]


def files_in(folder: Path, suffixes: Sequence[str], ending: str = "") -> dict[str, Path]:
    """The files of a folder by their names without suffix and ending; empty if there is no folder.
    Hidden files and folders are left out.

    Args:
        folder: is listed.
        suffixes: in lower case.
        ending: what a name must end in before its suffix.

    Raises:
        ValueError: two files have one name.
    """
    files: dict[str, Path] = {}
    for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
        wanted = entry.suffix.lower() in suffixes and entry.stem.endswith(ending)
        if wanted and not entry.name.startswith(".") and not entry.is_dir():
            earlier = files.setdefault(entry.stem.removesuffix(ending), entry)
            if earlier is not entry:
                raise ValueError(f"one frame is both {earlier} and {entry.name}")
    return files


def folders_in(folder: Path) -> list[Path]:
    """The folders in a folder in natural order; none if it is no folder."""
    entries = folder.iterdir() if folder.is_dir() else ()
    folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    return natsorted(sorted(folders), key=lambda entry: entry.name)


def itself_or_inside(root: Path, accepts: Callable[[Path], object]) -> list[Path]:
    """A folder, if it is accepted; otherwise the accepted folders in it."""
    return [root] if accepts(root) else [folder for folder in folders_in(root) if accepts(folder)]


def shortened(names: Sequence[str], most: int = 8) -> str:
    """Names in words, the first few of them: ``a, b and 12 more``."""
    if not names:
        return "nothing"
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def _label_finder(dataset: Dataset, folder: Path) -> Callable[[Frame], Path | None]:
    """Looks up a frame's label map, reading each folder once."""
    listed = cache(lambda place: files_in(place, LABEL_SUFFIXES))
    names = [frame.name for frame in dataset.frames]
    unambiguous = len(set(names)) == len(names)

    def find(frame: Frame) -> Path | None:
        own = frame.image or frame.label or dataset.root / frame.name
        places = [folder / frame.sequence, folder / own.parent.relative_to(dataset.root)]
        if folder.name == str(folder):
            places.append(own.parent.with_name(folder.name))
        if unambiguous:
            places.append(folder)
        stems = (frame.name, own.stem)
        return next((listed(p)[stem] for p in places for stem in stems if stem in listed(p)), None)

    return find
