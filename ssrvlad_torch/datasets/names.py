"""Names of sequences: the shortest paths that tell folders apart."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path, PurePath
from urllib.parse import unquote

KnownFolders = Collection[tuple[str, str]]
"""Folders that have a name: ``(folder, sequence)``; the folder is empty where it is not known."""


def sequence_names(folders: Collection[str], known: KnownFolders = ()) -> dict[str, str]:
    """A name for each folder.

    A known folder has the name of its sequence, also by a link. Another one has the last part of
    its path, and as many before it as it takes until no other folder's path ends so.

    Args:
        folders: absolute paths, or URIs.
        known: the folders that have a name.

    Raises:
        ValueError: a folder has several names, or can have none; or its name is that of a sequence
            whose folder is gone or not known, so that it may be the same.

    Example:
        >>> sequence_names(["/data/00/labels", "/data/01/labels", "/data/park"])
        {'/data/00/labels': '00/labels', '/data/01/labels': '01/labels', '/data/park': 'park'}
        >>> sequence_names(["/data/01/labels"], [("/data/00/labels", "labels")])
        {'/data/01/labels': '01/labels'}
    """
    given = _grouped((_real(folder), name) for folder, name in known if folder)
    owners = _grouped((name, folder) for folder, name in known)
    ends = Counter(end for path in {*folders, *(f for f, _ in known)} for end in _ends(path))

    def name(folder: str) -> str:
        if names := given.get(_real(folder)):
            return _only(folder, sorted(names))
        for end in _ends(folder):
            if end in owners:
                _see_that_one_is_there(owners[end], folder, end)
            elif ends[end] == 1:
                return end
        raise ValueError(f"{folder} needs a name that no sequence has: give it a --sequence")

    return {folder: name(folder) for folder in folders}


def check_sequences(these: KnownFolders, known: KnownFolders) -> None:
    """Refuses a folder whose sequence has the name of a known one of other folders.

    Args:
        these: folders, with their sequences.
        known: the folders that have a name.

    Raises:
        ValueError: there is one.
    """
    owners = _grouped((name, _real(folder)) for folder, name in known if folder)
    for folder, name in these:
        if folder and _real(folder) not in owners.get(name, {_real(folder)}):
            raise ValueError(
                f"sequence {name!r} of the database is {min(owners[name])}, not {folder}: give the "
                f"name of the sequence with --sequence, {name!r} if it is the same, moved"
            )


def is_uri(place: str) -> bool:
    """Whether a place is a URI, not a path or a glob."""
    return "://" in place


def is_same_folder(folder: str, other: str) -> bool:
    """Whether two folders are one, perhaps by a link."""
    return _real(folder) == _real(other)


def _real(folder: str) -> str:
    return os.path.realpath(folder) if folder and not is_uri(folder) else folder


def _ends(folder: str) -> list[str]:
    """What a path ends in, the shortest first."""
    if is_uri(folder):
        parts = [part for part in unquote(folder.partition("://")[2]).split("/") if part]
    else:
        path = PurePath(folder)
        parts = [part for part in path.parts if part != path.anchor] or [path.anchor]
    return ["/".join(parts[-count:]) for count in range(1, len(parts) + 1)]


def _grouped(pairs: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    grouped: dict[str, set[str]] = {}
    for key, value in pairs:
        grouped.setdefault(key, set()).add(value)
    return grouped


def _only(folder: str, names: list[str]) -> str:
    if len(names) > 1:
        raise ValueError(
            f"{folder} is sequence {names[0]!r} of the database and {names[1]!r}, too: say which "
            "with --sequence"
        )
    return names[0]


def _see_that_one_is_there(owners: Collection[str], folder: str, name: str) -> None:
    if not any(map(_is_there, owners)):
        known = max(owners)
        where = f"was encoded from {known}, which is gone" if known else "tells no folder"
        raise ValueError(
            f"sequence {name!r} of the database {where}: if {folder} is the same, say "
            f"--sequence {name}; else give it a name with --sequence"
        )


def _is_there(folder: str) -> bool:
    """Whether there is a folder, or a file that is a sequence without its suffix."""
    return is_uri(folder) or bool(
        folder and (Path(folder).exists() or glob.glob(f"{glob.escape(folder)}.*"))
    )


def absolute(path: Path) -> str:
    """An absolute path without ``.`` and ``..``; bytes that are no text are escaped. A symbolic
    link keeps its own name."""
    whole = os.fspath(path.resolve()) if ".." in path.parts else os.path.abspath(path)  # noqa: PTH100
    return whole.encode("utf-8", "backslashreplace").decode()
