"""Tables of poses, and which row of them is the pose of a frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from .frame_file import FrameFile
from .names import absolute_folder, is_same_folder, path_ends
from .poses import FILE_NAME, Pose, read_poses


@dataclass(frozen=True)
class PoseTable:
    """Poses of frames, and the file that holds them.

    A row is an id ``<folder>/<name>``, where the folder is any end of the path of the frame's
    folder or the name of its sequence, or only a name; with or without the suffix of the file. An
    id that names another folder beside the table is not the frame's.

    Attributes:
        path: the file.
        poses: by frame.
        folder: the folder for which the table was found, ``None`` if the user named the table.
    """

    path: Path
    poses: Mapping[str, Pose]
    folder: Path | None = None
    _users: dict[str, str] = field(default_factory=dict)
    _listed: dict[Path, dict[Path, frozenset[str]]] = field(default_factory=dict)

    @classmethod
    def of_folder(cls, folder: Path) -> PoseTable | None:
        """The ``poses.csv`` in a folder of frames or beside it; ``None`` without one."""
        for parent in (folder, absolute_folder(folder).parent):
            if (parent / FILE_NAME).is_file():
                return cls(parent / FILE_NAME, read_poses(parent / FILE_NAME), folder)
        return None

    def pose_of(self, file: FrameFile) -> Pose | None:
        """The pose of a frame; ``None`` if it has no row. Rows that differ, and one that can be
        that of another folder, are a ValueError."""
        folders = path_ends(file.folder)[::-1]
        other = self.path.parent / file.sequence
        if file.sequence not in folders and (
            not other.is_dir() or is_same_folder(str(other), file.folder)
        ):
            folders.append(file.sequence)
        suffixes = ("", file.path.suffix)
        ids = (f"{folder}/{file.name}{suffix}" for folder in folders for suffix in suffixes)
        rows = [key for key in ids if key in self.poses]
        if len({repr(self.poses[row]) for row in rows}) > 1:  # as text, NaN equals NaN
            raise ValueError(
                f"{self.path} has {rows[0]!r} and {rows[-1]!r} for {file.location}; expected one "
                "pose of a frame"
            )
        bare = [file.name + suffix for suffix in suffixes if file.name + suffix in self.poses]
        if bare and not rows:
            self._require_one_folder(file, bare[0])
        return self.poses[(rows or bare)[0]] if rows or bare else None

    def _require_one_folder(self, file: FrameFile, row: str) -> None:
        """Raises a ValueError if a row that is a bare name fits two frames: this one, and another
        frame that took it, or a file of the same name, without an id in the table, in a folder
        beside the frame's."""
        other = self._users.setdefault(row, file.folder)
        if other == file.folder and self.folder and self.path.parent != self.folder:
            home, place = absolute_folder(self.folder), file.path.relative_to(self.folder)
            if place.parent not in self._listed:
                self._listed[place.parent] = {
                    folder: frozenset(path.name for path in (folder / place.parent).glob("*"))
                    for folder in (home.parent, *home.parent.iterdir())
                    if folder.is_dir() and folder != home
                }
            for folder, names in self._listed[place.parent].items():
                ids = (f"{folder.name}/{file.name}{suffix}" for suffix in ("", file.path.suffix))
                if place.name in names and not any(name in self.poses for name in ids):
                    other = str(folder)
                    break
        if other != file.folder:
            raise ValueError(
                f"row {row!r} of {self.path} can be a frame of {file.folder} and of {other}; "
                "expected <folder>/<name>, or the table of one folder by --poses"
            )
