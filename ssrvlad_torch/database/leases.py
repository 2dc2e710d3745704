"""Versions of a local table that are in use, so that `engine.clean` does not delete them.

A user holds a shared lock of the operating system on the manifest of its version; the lock ends
with the process. In an object store, and on Windows, there are no such locks.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from .disk import is_local

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from lance import LanceDataset

_LAST_VERSION = (1 << 64) - 1


class Lease:
    """A lock on an open file, until this object is deleted."""

    def __init__(self, path: Path, exclusive: bool) -> None:
        """Raises OSError if the file does not exist or is locked otherwise."""
        self._file = os.open(path, os.O_RDONLY)
        fcntl.flock(self._file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        if not os.fstat(self._file).st_nlink:
            raise FileNotFoundError(f"{path} was deleted")

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            os.close(self._file)


def manifest(uri: str, version: int) -> Path:
    """The file that makes a version of a local table."""
    return Path(uri, "_versions", f"{_LAST_VERSION - version}.manifest")


def version_of(file: Path) -> int:
    """The version that a manifest makes."""
    return _LAST_VERSION - int(file.stem)


def has_leases(uri: str) -> bool:
    """Whether users of a table can hold versions."""
    return fcntl is not None and is_local(uri)


def hold(table: LanceDataset) -> bool:
    """Holds a table's version while the object lives; ``False`` if it is, or is being, deleted."""
    if has_leases(table.uri):
        try:
            table.__dict__["lease"] = Lease(manifest(table.uri, table.version), exclusive=False)
        except (FileNotFoundError, BlockingIOError):
            return False
    return True


def seize(uri: str, version: int) -> Lease | None:
    """An exclusive lock on a version that nobody uses; ``None`` if somebody does."""
    try:
        return Lease(manifest(uri, version), exclusive=True)
    except (FileNotFoundError, BlockingIOError):
        return None
