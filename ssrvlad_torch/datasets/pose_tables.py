"""The poses of frames: from the source that the user names, or from tables beside the frames."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from unicodedata import normalize

from ..files import check_regular, naming, read_text, replacing
from .camera_poses import read_colmap
from .frame_file import FrameFile
from .names import absolute, absolute_folder, is_same_folder, path_ends
from .poses import NOWHERE, UNKNOWN, Fix, Pose, Projection, read_exif, read_name, zone_of_name
from .trajectories import frame_key, read_poses, read_trajectory

FILE_NAME = "poses.csv"


def read_table(path: Path, projection: Projection) -> dict[str, Pose] | None:
    """The poses of a file that has them by frame, see `read_poses`: such a ``.csv``, or COLMAP's
    ``images.txt``; ``None`` for one that has them by time or number."""
    suffix = path.suffix.lower()
    text = "" if suffix == ".gpx" else read_text(path)
    if suffix == ".csv" and not text.lstrip("# ").startswith("timestamp"):
        return read_poses(path, projection)
    if path.name == "images.txt" or "IMAGE_ID, QW" in text:
        return {frame_key(frame): pose for frame, pose in read_colmap(path, text).items()}
    return None


def write_poses(path: Path, poses: Mapping[str, Pose]) -> None:
    """Writes a table ``frame,x,y,heading`` that `read_poses` reads."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame", *Pose._fields))
        rows.writerows((frame, *pose) for frame, pose in poses.items())


@dataclass(frozen=True)
class PoseTable:
    """Poses of frames in a file; ``folder`` is that for which it was found, ``None`` if the user
    named it. A row is an id ``<folder>/<name>``, where the folder is an end of the path of the
    frame's folder or the name of its sequence, or only a name."""

    path: Path
    poses: Mapping[str, Pose]
    folder: Path | None = None
    _users: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of_folder(cls, folder: Path, projection: Projection | None = None) -> PoseTable | None:
        """The ``poses.csv`` in a folder of frames or beside it; ``None`` without one."""
        for parent in (folder, absolute_folder(folder).parent):
            path = parent / FILE_NAME
            if path.is_file():
                return cls(path, read_poses(path, projection), folder)
        return None

    def pose_of(self, file: FrameFile) -> Pose | None:
        """The pose of a frame, ``None`` without a row; an ambiguous row is a ValueError."""
        name, folders = frame_key(file.name), path_ends(normalize("NFC", file.folder))[::-1]
        other = self.path.parent / file.sequence
        if not other.is_dir() or is_same_folder(str(other), file.folder):
            folders.append(file.sequence)
        rows = [row for folder in folders if (row := f"{folder}/{name}") in self.poses]
        if not rows and name in self.poses:
            self._require_one_folder(file, name)
            rows = [name]
        poses = {repr(self.poses[row]): self.poses[row] for row in rows}  # by text NaN equals NaN
        if len(poses) > 1:
            raise ValueError(
                f"{self.path} has {rows[0]!r} and {rows[-1]!r} for {file.location}; expected one "
                "pose of a frame"
            )
        return next(iter(poses.values()), None)

    def misfit(self, without: Sequence[FrameFile], count: int) -> str:
        """That the table lacks some of ``count`` frames, with one of them and a row, in words."""
        row = f"it has, for example, {next(iter(self.poses))!r}" if self.poses else "it is empty"
        share = f"{count - len(without)} of {count}" if len(without) < count else "none of the"
        return f"{self.path} has {share} frames, not {without[0].frame} for example; {row}"

    def _require_one_folder(self, file: FrameFile, row: str) -> None:
        """Raises a ValueError if a bare name fits another frame too, which took it before or is a
        file of that name, without a row of its own, in a folder beside the frame's."""
        users = [self._users.setdefault(row, file.folder)]
        for folder in self._beside:
            is_there = (folder / file.path.relative_to(self.folder or "")).exists()
            if is_there and f"{folder.name}/{row}" not in self.poses:
                users.append(absolute(folder))
        for user in users:
            if user != file.folder:
                raise ValueError(
                    f"row {row!r} of {self.path} can be a frame of {file.folder} and of {user}; "
                    "expected <folder>/<name>, or the table of one folder by --poses"
                )

    @cached_property
    def _beside(self) -> list[Path]:
        """The folders in that of a table, and this one, without the one for which it was found."""
        if not self.folder or self.path.parent == self.folder:
            return []
        home = absolute_folder(self.folder)
        folders = (home.parent, *home.parent.iterdir())
        return [folder for folder in folders if folder != home and folder.is_dir()]


def with_poses_of(
    source: str, sequences: Sequence[list[FrameFile]], projection: Projection
) -> list[list[FrameFile]]:
    """The files of each sequence with their poses in a file that has them by frame, see
    `read_table`, or by time, see `read_trajectory`, or with ``exif`` in their EXIF tags. A source
    that gives no pose is a ValueError."""
    path = Path(source)
    if source == "exif":
        fixes = [[*map(_fix_of, files)] for files in sequences]
        for files, of_files in zip(sequences, fixes, strict=True):
            if not any(fix.is_known for fix in of_files):
                raise ValueError(f"no image of {files[0].sequence} has a position in its EXIF tags")
        poses = [projection.poses(of_files) for of_files in fixes]
    elif not path.is_file():
        raise ValueError(f"{source} is no file; expected a file of poses, or exif")
    elif (rows := read_table(path, projection)) is not None:
        table = PoseTable(path, rows)
        poses = [[table.pose_of(file) or UNKNOWN for file in files] for files in sequences]
        if all(pose is UNKNOWN for of_sequence in poses for pose in of_sequence):
            files = [file for of_sequence in sequences for file in of_sequence]
            raise ValueError(table.misfit(files, len(files)))
    elif len(sequences) > 1:
        raise ValueError(f"{source} holds the poses of one sequence, got {len(sequences)}")
    else:
        trajectory = read_trajectory(path, projection)
        names, stamps = zip(*((file.name, file.stamp) for file in sequences[0]), strict=True)
        with naming(source):
            poses = [trajectory.of_frames(names, stamps)]
    return [
        [
            replace(file, pose=pose, has_pose_source=True)
            for file, pose in zip(files, of_files, strict=True)
        ]
        for files, of_files in zip(sequences, poses, strict=True)
    ]


def _fix_of(file: FrameFile) -> Fix:
    with suppress(ValueError, OSError):
        if file.listed:
            return read_exif(io.BytesIO(file.read()))
        check_regular(file.path)  # to open a pipe can block for ever
        return read_exif(file.path)
    return NOWHERE


def with_poses_beside(
    files: Sequence[FrameFile], projection: Projection, note: Callable[[str], object]
) -> list[FrameFile]:
    """The files with the poses of tables beside them or of their names, see `with_pose`; a table
    with fewer than half of the frames of a folder is noted."""
    find = cache(lambda folder: PoseTable.of_folder(folder, projection))
    posed = [with_pose(file, find) for file in files]
    zones = {zone_of_name(file.name) for file in files} - {""}
    if len(zones) > 1:
        note(f"names of files have positions of UTM zones {', '.join(sorted(zones))}; expected one")
    folders = dict[Path, list[FrameFile]]()
    for file in posed:
        folders.setdefault(file.path.parent, []).append(file)
    for folder, neighbours in folders.items():
        table = None if neighbours[0].listed else find(folder)
        without = [f for f in neighbours if table and math.isnan(f.pose.x) and not table.pose_of(f)]
        if table and 2 * len(without) > len(neighbours):
            note(table.misfit(without, len(neighbours)))
    return posed


def with_pose(file: FrameFile, find: Callable[[Path], PoseTable | None]) -> FrameFile:
    """A file with the pose of the table that ``find`` gives for its folder, or of its name, see
    `read_name`; a ValueError if a table is damaged, or can mean two frames."""
    if file.listed:
        return file
    (pose, stamp), table = read_name(file.name), find(file.path.parent)
    pose = (table and table.pose_of(file)) or pose
    stamp = stamp if math.isnan(file.stamp) else file.stamp
    has_source = bool(table) or not math.isnan(pose.x)
    return replace(file, pose=pose, stamp=stamp, has_pose_source=has_source)
