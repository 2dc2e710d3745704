"""A data set on disk: its frames, which of them are queries, and what is a true match."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, partial
from itertools import groupby, islice
from pathlib import Path
from typing import Literal

from natsort import natsorted

from ..taxonomy import LabelSpace, label_space
from .frame_file import FrameFile
from .label_files import SUFFIXES as LABEL_SUFFIXES
from .names import IMAGE_SUFFIXES, id_of
from .poses import UNKNOWN, Pose

LabelsAs = str | LabelSpace | None
"""A label space or its name, if there is one."""

Role = Literal["reference", "query"]
Kind = Literal["image", "label"]


@dataclass(frozen=True)
class DatasetFrame:
    """A frame ``<sequence>/<name>``: its image and label map, ``None`` if not on disk, its pose in
    metres and radians, NaN where unknown, and its declared role."""

    sequence: str
    name: str
    image: Path | None = None
    label: Path | None = None
    pose: Pose = UNKNOWN
    role: Role | None = None

    @property
    def frame(self) -> str:
        """The frame's id."""
        return id_of(self.sequence, self.name)

    @property
    def has_pose(self) -> bool:
        """Whether the position of the frame is known."""
        return not (math.isnan(self.pose.x) or math.isnan(self.pose.y))


@dataclass(frozen=True)
class GroundTruth:
    """What a true match is: by a file, or by the largest distance in metres on the ground, then
    also in degrees of heading, or in frames. Not exactly one of the three is a ValueError."""

    file: Path | None = None
    metres: float | None = None
    degrees: float | None = None
    frames: int | None = None

    def __post_init__(self) -> None:
        count = sum(value is not None for value in (self.file, self.metres, self.frames))
        if count != 1:
            raise ValueError(
                "expected one of --ground-truth, --tolerance-metres and --tolerance-frames, "
                f"got {count} of them"
            )
        if self.degrees is not None and self.metres is None:
            raise ValueError("--tolerance-degrees needs --tolerance-metres")

    @classmethod
    def chosen(
        cls,
        declared: GroundTruth | None,
        file: Path | None,
        metres: float | None,
        degrees: float | None,
        frames: int | None,
    ) -> GroundTruth:
        """The definition by a file or a distance, or the declared one if neither is given; degrees
        that are given count for both."""
        if declared and (file, metres, frames) == (None,) * 3:
            return declared if degrees is None else replace(declared, degrees=degrees)
        return cls(file, metres, degrees, frames)

    @property
    def words(self) -> str:
        """The definition in words."""
        if self.file is not None:
            return str(self.file)
        if self.frames is not None:
            return f"at most {self.frames} frame{'s'[: self.frames != 1]} away"
        turned = "" if self.degrees is None else f" and {self.degrees:g} degrees"
        return f"within {self.metres:g} metres{turned}"


@dataclass(frozen=True)
class Dataset:
    """A data set on disk: frames by sequence in natural order, the label space of its label maps
    and what a true match is, if known, and a line for each part that this copy lacks."""

    layout: str
    root: Path
    frames: tuple[DatasetFrame, ...]
    labels_as: LabelsAs = None
    truth: GroundTruth | None = None
    notes: tuple[str, ...] = ()

    @property
    def sequences(self) -> list[str]:
        """The names of the sequences."""
        return [*dict.fromkeys(frame.sequence for frame in self.frames)]

    @property
    def warnings(self) -> list[str]:
        """The notes, and a line for each kind of file or pose that some frames lack."""
        missing = {
            "image": [frame for frame in self.frames if frame.image is None],
            "label map": [frame for frame in self.frames if frame.label is None],
            "pose": [frame for frame in self.frames if not frame.has_pose],
        }
        return [*self.notes] + [
            f"{len(without)} of {len(self.frames)} frames have no {kind}, the first is "
            f"{without[0].frame}"
            for kind, without in missing.items()
            if 0 < len(without) < len(self.frames)
        ]

    def select(self, patterns: Sequence[str] = (), role: Role | None = None) -> Dataset:
        """The frames of a role, if given, and of the sequences that match a pattern, if any (``*``,
        ``?``). A pattern that matches none, and a role that none has, are a ValueError."""
        names = self.sequences
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise ValueError(
                    f"{self.root} has no sequence {pattern!r}; it has {shortened(names)}"
                )
        if patterns:
            names = [name for name in names if any(fnmatchcase(name, p) for p in patterns)]
        frames = tuple(
            frame for frame in self.frames if frame.sequence in names and role in (None, frame.role)
        )
        if not frames:
            raise ValueError(
                f"{self.root} does not say which of {shortened(names)} is a {role}; name it"
            )
        return replace(self, frames=frames)

    def posed(self) -> Dataset:
        """The data set without the frames of unknown pose; a ValueError if no frame has a pose."""
        frames = tuple(frame for frame in self.frames if frame.has_pose)
        if not frames:
            raise ValueError(f"no frame of {self.root} ({self.layout}) has a pose")
        return replace(self, frames=frames)

    def with_labels(self, folder: str | Path, labels_as: str | LabelSpace) -> Dataset:
        """The data set with label maps of another folder and label space. A map has the name of its
        frame or image, and is in ``folder/<sequence>``, in ``folder/<path of the image's folder>``,
        in the folder called ``folder`` beside that of the image, or, if all names differ, in
        ``folder``. None there, or an unknown label space, is a ValueError."""
        label_space(labels_as)
        outside, listed = Path(folder), cache(labels_in)
        unambiguous = len({frame.name for frame in self.frames}) == len(self.frames)

        def find(frame: DatasetFrame) -> Path | None:
            path = frame.image or frame.label or self.root / frame.name
            folders = [outside / frame.sequence, outside / path.parent.relative_to(self.root)]
            if outside.name == str(outside):
                folders.append(path.parent.with_name(outside.name))
            if unambiguous:
                folders.append(outside)
            places = (
                (listed(folder), stem) for folder in folders for stem in (frame.name, path.stem)
            )
            return next((files[stem] for files, stem in places if stem in files), None)

        frames = tuple(replace(frame, label=find(frame)) for frame in self.frames)
        if all(frame.label is None for frame in frames):
            frame = frames[0]
            raise ValueError(
                f"{folder} holds no label map of a frame of {self.root}; expected, for example, "
                f"{outside / frame.sequence / frame.name}.png"
            )
        return replace(self, frames=frames, labels_as=labels_as)

    def files(self, kind: Kind, every: int = 1, start: int = 0) -> list[FrameFile]:
        """The images or label maps of the frames, see `find_frames`; without any, a ValueError."""
        posed = {frame.sequence for frame in self.frames if frame.has_pose}
        files = [
            FrameFile(f.sequence, f.name, path, None, f.pose, has_pose_source=f.sequence in posed)
            for f in self.frames
            if (path := f.image if kind == "image" else f.label)
        ]
        if not files:
            hint = "; segment its images and give the folder of the results and their label space"
            missing = "images" if kind == "image" else f"label maps{hint}"
            raise ValueError(f"{self.root} ({self.layout}) has no {missing}")
        sequences = groupby(files, key=lambda file: file.sequence)
        selected = [file for _, of in sequences for file in islice(of, start, None, every)]
        if not selected:
            raise ValueError(f"no sequence of {self.root} has a frame {start}")
        return selected


def files_in(suffixes: Sequence[str], folder: Path) -> dict[str, Path]:
    """The shown files of a folder, if it exists, with one of the suffixes, by their names without
    it. Two of one name are a ValueError."""
    files: dict[str, Path] = {}
    for entry in sorted(folder.iterdir()) if folder.is_dir() else ():
        matches = entry.suffix.lower() in suffixes and not entry.name.startswith(".")
        if matches and not entry.is_dir():
            earlier = files.setdefault(entry.stem, entry)
            if earlier is not entry:
                raise ValueError(f"one frame is both {earlier} and {entry.name}")
    return files


images_in, labels_in = partial(files_in, IMAGE_SUFFIXES), partial(files_in, LABEL_SUFFIXES)


def folders_in(folder: Path) -> list[Path]:
    """The folders in a folder in natural order; empty if ``folder`` is not a folder."""
    entries = folder.iterdir() if folder.is_dir() else ()
    folders = [entry for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
    return natsorted(sorted(folders), key=lambda entry: entry.name)


def shortened(names: Sequence[str], most: int = 8) -> str:
    """The first ``most`` names, and the number of the others: ``a, b and 12 more``."""
    if not names:
        return "nothing"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
