"""Tables of poses, ``poses.csv`` and its like, and which row of them is the pose of a frame."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePosixPath
from unicodedata import normalize

from ..files import read_text, replacing
from .camera_poses import KITTI_360, read_colmap, read_kitti_360, words_of
from .frame_file import FrameFile
from .names import IMAGE_SUFFIXES, absolute, absolute_folder, is_same_folder, path_ends
from .poses import UNKNOWN, Fix, Pose, Projection, parse_number

FILE_NAME = "poses.csv"
_FRAME_DIGITS = 10
"""Of the number of a frame; a time in nanoseconds has more."""


def read_poses(path: Path, projection: Projection | None = None) -> dict[str, Pose]:
    """Poses by frame, an id ``<sequence>/<name>`` or only a name, without the suffix of a picture
    and in Unicode's form NFC. The columns are ``frame``, ``x``, ``y`` and optionally ``heading`` in
    metres and radians; or ``frame``, ``latitude`` and ``longitude`` in degrees and optionally
    ``course``, in degrees clockwise from north. A missing column, more cells than columns, a value
    that is no number, and one NaN of two coordinates are a ValueError that names file and line."""
    rows = csv.DictReader(io.StringIO(read_text(path)), restval="", skipinitialspace=True)
    poses, fixes = dict[str, Pose](), dict[str, Fix]()
    try:
        columns = rows.fieldnames or ()
        if repeated := next((column for column in columns if columns.count(column) > 1), ""):
            raise ValueError(f"two columns {repeated!r}")
        is_gps = {"frame", "latitude", "longitude"} <= set(columns)
        missing = {"frame", "x", "y"} - set(columns)
        if missing and not is_gps:
            raise ValueError(f"no column {min(missing)!r}; expected frame,x,y,heading")
        first, second, third = Fix._fields if is_gps else Pose._fields
        for row in rows:
            if any(more := row.get(None, ())):  # as by decimal commas, not by one at the end
                raise ValueError(f"more cells than columns: {','.join(more)}")
            x, y = parse_number(row[first]), parse_number(row[second])
            direction = parse_number(row.get(third) or "nan")
            if math.isnan(x) != math.isnan(y):
                raise ValueError(
                    f"{first} is {row[first]} and {second} is {row[second]}; "
                    "expected two numbers, or nan twice"
                )
            key, position = _key(row["frame"]), (x, y, direction)
            if is_gps and Fix(*position).is_known:
                fixes[key] = Fix(*position)
            if repr(poses.setdefault(key, Pose(*position))) != repr(Pose(*position)):  # also NaN
                raise ValueError(f"frame {row['frame']!r} has two positions")
    except (csv.Error, ValueError) as error:
        raise ValueError(f"{path} line {rows.line_num}: {error}") from error
    if is_gps:
        converted = (projection or Projection()).poses([*fixes.values()])
        return dict.fromkeys(poses, UNKNOWN) | dict(zip(fixes, converted, strict=True))
    return poses


def read_table(path: Path, projection: Projection) -> dict[str, Pose] | None:
    """The poses of a file that has them by frame, as `read_poses`: such a ``.csv``, COLMAP's
    ``images.txt`` or a file of KITTI-360; ``None`` for one that has them by time or number."""
    if path.suffix.lower() == ".gpx":
        return None
    text = read_text(path)
    _, words = next(words_of(path, text.replace(",", " ")), ("", []))
    if path.suffix.lower() == ".csv":
        by_time = text.lstrip("# ").startswith("timestamp")
        return None if by_time else read_poses(path, projection)
    if path.name == "images.txt" or "IMAGE_ID, QW" in text:
        poses = read_colmap(path, text)
    elif len(words) in KITTI_360 and words[0].isdecimal() and len(words[0]) <= _FRAME_DIGITS:
        poses = read_kitti_360(path, text)
    else:
        return None
    return {_key(frame): pose for frame, pose in poses.items()}


def write_poses(path: Path, poses: Mapping[str, Pose]) -> None:
    """Writes a table ``frame,x,y,heading`` that `read_poses` reads."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("frame", *Pose._fields))
        rows.writerows((frame, *pose) for frame, pose in poses.items())


@dataclass(frozen=True)
class PoseTable:
    """Poses of frames, and the file that holds them. A row is an id ``<folder>/<name>``, where the
    folder is any end of the path of the frame's folder or the name of its sequence, or only a name.
    An id that names another folder beside the table is not the frame's.

    Attributes:
        path: the file.
        poses: by frame, see `read_poses`.
        folder: the folder for which the table was found, ``None`` if the user named the table.
    """

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
        """The pose of a frame; ``None`` if it has no row. Rows that differ, and one that can be
        that of another folder, are a ValueError."""
        name, folders = _key(file.name), path_ends(normalize("NFC", file.folder))[::-1]
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
        """Raises a ValueError if a row that is a bare name fits two frames: this one, and one that
        took it before, or a file of the same name in a folder beside the frame's that has no row of
        its own."""
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


def _key(frame: str) -> str:
    """An id or a name without the suffix of a picture, in Unicode's form NFC."""
    path = PurePosixPath(frame)
    is_picture = path.suffix.lower() in IMAGE_SUFFIXES
    return normalize("NFC", frame.removesuffix(path.suffix) if is_picture else frame)
