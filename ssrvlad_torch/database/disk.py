"""Files that Lance wrote on a local disk: checked to be whole, flushed, and kept while in use.

Lance does not flush files, and does not report every write that fails. In an object store, files
are whole once they are there: nothing is done for them.

A user of a version holds a shared lock of the operating system on its manifest, so that
`engine.clean` does not delete it; the lock ends with the process. In an object store, and on
Windows, there are no such locks.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from ..files import flush, is_uri

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from lance import LanceDataset
    from lance.fragment import FragmentMetadata

_BITMAP_WITHOUT_RUNS = 12346
_ARRAY_LIMIT, _BITMAP_BYTES = 4096, 8192
_LAST_VERSION = (1 << 64) - 1


def flush_fragments(uri: str, fragments: Iterable[FragmentMetadata]) -> None:
    """Flushes the files of fragments; raises OSError unless a data file has the size, and a file of
    deleted rows the number of rows, that Lance recorded."""
    if is_uri(uri):
        return
    paths: list[Path] = []
    for fragment in fragments:
        whole = {}
        for file in fragment.files:
            path, size = Path(uri, "data", file.path), file.file_size_bytes
            whole[path] = not size or path.stat().st_size == size
        if deletions := fragment.deletion_file:
            path = Path(uri, deletions.path(fragment.id))
            whole[path] = deleted_rows(path) == deletions.num_deleted_rows
        if truncated := [path for path in whole if not whole[path]]:
            reason = f"{os.strerror(errno.EIO)}: not all was written"
            raise OSError(errno.EIO, reason, str(truncated[0]))
        paths += whole
    flush_files(uri, paths)


def flush_files(uri: str, files: Iterable[Path]) -> None:
    """Flushes files of a table and the folders that hold them."""
    if is_uri(uri):
        return
    files = list(files)
    for file in files:
        flush(file)
    for folder in {parent for file in files for parent in (file.parent, Path(uri))}:
        flush(folder)


def deleted_rows(path: Path) -> int | None:
    """The number of rows in a file of deleted rows, of Arrow or a Roaring bitmap without runs
    (RoaringFormatSpec); ``None`` if the file is not whole."""
    content = path.read_bytes()
    if path.suffix != ".bin":
        try:
            return int(pa.ipc.open_file(content).read_all().num_rows)
        except pa.ArrowInvalid:
            return None
    if len(content) < 8:
        return None
    cookie, containers = np.frombuffer(content, "<u4", 2).tolist()
    header = 8 + 8 * containers
    if cookie != _BITMAP_WITHOUT_RUNS or len(content) < header:
        return None
    counts = np.frombuffer(content, "<u2", 2 * containers, 8)[1::2].astype(np.int64) + 1
    sizes = np.where(counts <= _ARRAY_LIMIT, 2 * counts, _BITMAP_BYTES)
    return int(counts.sum()) if len(content) == header + sizes.sum() else None


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


def local_versions(uri: str) -> list[int]:
    """The stored versions of a local table, the oldest first; none of one in an object store."""
    return sorted(_LAST_VERSION - int(f.stem) for f in Path(uri, "_versions").glob("*.manifest"))


def has_leases(uri: str) -> bool:
    """Whether users of a table can hold versions."""
    return fcntl is not None and not is_uri(uri)


def hold(table: LanceDataset) -> bool:
    """Holds a table's version while the object lives; ``False`` if it is, or is being, deleted."""
    if not has_leases(table.uri):
        return True
    lease = table.__dict__["lease"] = take_lease(table.uri, table.version, exclusive=False)
    return lease is not None


def take_lease(uri: str, version: int, exclusive: bool) -> Lease | None:
    """A lock on a version; ``None`` if the version is deleted or locked otherwise."""
    try:
        return Lease(manifest(uri, version), exclusive)
    except (FileNotFoundError, BlockingIOError):
        return None
