"""Names of sequences: the shortest paths that tell folders apart."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path, PurePath
from urllib.parse import unquote


def names_of(folders: Collection[str], known: Mapping[str, str] | None = None) -> dict[str, str]:
    """A name for each folder, no two alike: the last part of its path, and as many before it as
    needed.

    Args:
        folders: absolute paths, or URIs.
        known: names of folders that keep them, by the folder.

    Raises:
        ValueError: a name is that of a known folder which is gone: the new one may be the same,
            moved.

    Example:
        >>> names_of(["/data/00/labels", "/data/01/labels", "/data/park"])
        {'/data/00/labels': '00/labels', '/data/01/labels': '01/labels', '/data/park': 'park'}
    """
    known = dict(known or {})
    new = {folder: _parts(folder) for folder in folders if folder not in known}
    owners = {name: folder for folder, name in known.items()}
    names = {}
    for folder, parts in new.items():
        others = [p for other, p in new.items() if other != folder]
        for count in range(1, len(parts) + 1):
            name = "/".join(parts[-count:])
            if name in owners:
                _see_that_it_is_there(owners[name], folder, name)
            elif all(parts[-count:] != other[-count:] for other in others):
                names[folder] = name
                break
        else:
            raise ValueError(f"{folder} needs a name that no sequence has: give it a --sequence")
    return {folder: known.get(folder) or names[folder] for folder in folders}


def is_uri(place: str) -> bool:
    """Whether a place is a URI, not a path or a glob."""
    return "://" in place


def _parts(folder: str) -> tuple[str, ...]:
    if is_uri(folder):
        return tuple(part for part in unquote(folder.partition("://")[2]).split("/") if part)
    path = PurePath(folder)
    return tuple(part for part in path.parts if part != path.anchor) or (path.anchor,)


def _see_that_it_is_there(known: str, folder: str, name: str) -> None:
    if not is_uri(known) and not Path(known).exists():
        raise ValueError(
            f"sequence {name!r} was encoded from {known}, which is gone: if {folder} is the same, "
            f"moved, say --sequence {name}; else give it a name with --sequence"
        )


def absolute(path: Path) -> str:
    """An absolute path without ``.`` and ``..``; bytes that are no text are escaped. A symbolic
    link keeps its own name."""
    whole = os.fspath(path.resolve()) if ".." in path.parts else os.path.abspath(path)  # noqa: PTH100
    return whole.encode("utf-8", "backslashreplace").decode()
