"""Tables of poses, and which row of them is the pose of a frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from unicodedata import normalize

from .frame_file import FrameFile
from .names import IMAGE_SUFFIXES, absolute, absolute_folder, is_same_folder, path_ends
from .poses import FILE_NAME, Pose, Projection, read_poses


@dataclass(frozen=True)
class PoseTable:
    """Poses of frames, and the file that holds them.

    A row is an id ``<folder>/<name>``, where the folder is any end of the path of the frame's
    folder or the name of its sequence, or only a name; with or without a suffix of pictures. An id
    that names another folder beside the table is not the frame's.

    Attributes:
        path: the file.
        poses: by frame.
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
        folders = path_ends(normalize("NFC", file.folder))[::-1]
        other = self.path.parent / file.sequence
        if file.sequence not in folders and (
            not other.is_dir() or is_same_folder(str(other), file.folder)
        ):
            folders.append(file.sequence)
        rows, name = list[str](), normalize("NFC", file.name)
        for suffixes in (("", file.path.suffix), IMAGE_SUFFIXES):
            names = [name + suffix for suffix in suffixes if not rows]
            rows += [row for f in folders for n in names if (row := f"{f}/{n}") in self.poses]
            if not rows and (rows := [name for name in names if name in self.poses]):
                self._require_one_folder(file, rows[0])
        if len({repr(self.poses[row]) for row in rows}) > 1:  # as text, NaN equals NaN
            raise ValueError(
                f"{self.path} has {rows[0]!r} and {rows[-1]!r} for {file.location}; expected one "
                "pose of a frame"
            )
        return self.poses[rows[0]] if rows else None

    def _require_one_folder(self, file: FrameFile, row: str) -> None:
        """Raises a ValueError if a row that is a bare name fits two frames: this one, and one that
        took it before, or a file of the same name in a folder beside the frame's that has no row of
        its own."""
        users = [self._users.setdefault(row, file.folder)]
        for folder in self._beside:
            ids = {f"{folder.name}/{name}" for name in (row, file.name, file.path.name)}
            if (folder / file.path.relative_to(self.folder or "")).exists():
                users += [] if ids & self.poses.keys() else [absolute(folder)]
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
