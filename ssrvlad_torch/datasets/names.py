"""Names of sequences: the shortest ends of paths that distinguish their folders; ids of frames."""

import os
import sys
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path, PurePath
from urllib.parse import unquote

from ..files import is_uri

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".ppm", ".npy")
BAG_SUFFIXES = (".bag", ".mcap", ".db3")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".ts", ".mts")

SequenceFolders = Collection[tuple[str, str]]
"""Pairs of a folder, stack, bag or video and the name of its sequence; an unknown folder is
empty."""


def sequence_names(folders: Collection[str], map_folders: SequenceFolders = ()) -> dict[str, str]:
    """A name for each folder, absolute paths or URIs: that which a folder of the map, or a link to
    one, has, or the shortest end of its path that no other folder's path ends in. Several names, no
    free name, and the name of a sequence whose folder is missing or unknown, so that it may be the
    same one, are a ValueError.

    Examples:
        >>> sequence_names(["/data/00/labels", "/data/park"], [("/data/park", "garden")])
        {'/data/00/labels': 'labels', '/data/park': 'garden'}
    """
    names_of, owners = defaultdict[str, set[str]](set), _owners(map_folders)
    for folder, name in map_folders:
        if folder:
            names_of[_real(folder)].add(name)
    paths = {*folders, *(folder for folder, _ in map_folders)}
    ends = Counter(end for path in paths for end in path_ends(path))
    chosen: dict[str, str] = {}
    for folder in folders:
        if names := sorted(names_of.get(_real(folder), ())):
            if len(names) > 1:
                raise ValueError(
                    f"{folder} is sequence {names[0]!r} and sequence {names[1]!r} of the database: "
                    "choose one with --sequence"
                )
            chosen[folder] = names[0]
            continue
        for end in path_ends(folder):
            if end in owners:
                if any(is_uri(o) or (o and Path(o).exists()) for o in owners[end]):
                    continue
                owner = max(owners[end])
                origin = (
                    f"was encoded from {owner}, which is gone" if owner else "has no known folder"
                )
                raise ValueError(
                    f"sequence {end!r} of the database {origin}: if {folder} is the same, give "
                    f"--sequence {end}, else another name"
                )
            if ends[end] == 1:
                chosen[folder] = end
                break
        else:
            raise ValueError(
                f"{folder} needs a name that no sequence has: give one with --sequence"
            )
    return chosen


def check_sequences(folders: SequenceFolders, map_folders: SequenceFolders) -> None:
    """Raises a ValueError for a sequence with the name of one of the map, of another folder."""
    owners = _owners((_real(folder), name) for folder, name in map_folders if folder)
    for folder, name in folders:
        if folder and name in owners and _real(folder) not in owners[name]:
            raise ValueError(
                f"sequence {name!r} of the database is {min(owners[name])}, not {folder}: give "
                f"--sequence {name} if the folder was moved, else another name"
            )


def _owners(folders: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """The folders of each sequence."""
    owners: dict[str, set[str]] = {}
    for folder, name in folders:
        owners.setdefault(name, set()).add(folder)
    return owners


def is_same_folder(folder: str, second: str) -> bool:
    """Whether two paths lead to one folder, directly or by links."""
    return _real(folder) == _real(second)


def _real(folder: str) -> str:
    return os.path.realpath(folder) if folder and not is_uri(folder) else folder


def path_ends(folder: str) -> list[str]:
    """The ends of a path or a URI, the shortest first; of a stack, bag or video without suffix."""
    if is_uri(folder):
        parts = [name for name in unquote(folder.partition("://")[2]).split("/") if name]
    else:
        path = PurePath(folder)
        if path.suffix.lower() in (".npy", *BAG_SUFFIXES, *VIDEO_SUFFIXES):
            path = path.with_suffix("")
        parts = [name for name in path.parts if name != path.anchor] or [path.anchor]
    return ["/".join(parts[-count:]) for count in range(1, len(parts) + 1)]


def absolute(path: Path) -> str:
    """An absolute path without ``.`` and ``..``, with escapes for bytes that are not UTF-8."""
    text = os.fspath(path.resolve()) if ".." in path.parts else os.path.abspath(path)  # noqa: PTH100
    if sys.getfilesystemencoding() == "ascii" and not text.isascii():
        raise ValueError(
            f"names of files are read as ASCII here, got {text!a}; expected UTF-8: set PYTHONUTF8=1"
        )
    return text.encode("utf-8", "backslashreplace").decode()


def absolute_folder(folder: Path) -> Path:
    """A folder's absolute path, in which ``.`` and ``..`` have a name, and a link has its own."""
    path = folder.absolute()
    return path.resolve() if path.name == ".." else path


def id_of(sequence: str, name: str) -> str:
    """A frame's id, ``<sequence>/<name>``, or the name if there is no sequence."""
    return f"{sequence}/{name}" if sequence else name


def split_id(frame: str) -> tuple[str, str]:
    """The sequence, empty if there is none, and the name of a frame."""
    sequence, _, name = frame.rpartition("/")
    return sequence, name


def sequence_of(frame: str) -> str:
    """The sequence of a frame, empty if there is none."""
    return split_id(frame)[0]


def name_of(frame: str) -> str:
    """The name of a frame in its sequence."""
    return split_id(frame)[1]
