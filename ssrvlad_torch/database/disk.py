"""Files that Lance wrote on a local disk: checked to be whole, and flushed.

Lance does not flush files, and does not report every write that fails. In an object store, files
are whole once they are there: nothing is done for them.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from ..files import flush

if TYPE_CHECKING:
    from lance.fragment import DataFile, DeletionFile, FragmentMetadata

_BITMAP_WITHOUT_RUNS = 12346
_ARRAY_LIMIT, _BITMAP_BYTES = 4096, 8192


def is_local(uri: str) -> bool:
    """Whether a table is a local folder, and not in an object store."""
    return "://" not in uri


def flush_fragments(uri: str, fragments: Iterable[FragmentMetadata]) -> None:
    """Flushes the files of fragments; raises OSError if one is not whole."""
    if not is_local(uri):
        return
    paths = []
    for fragment in fragments:
        for file in fragment.files:
            paths.append(Path(uri, "data", file.path))
            check_data(paths[-1], file)
        if deletions := fragment.deletion_file:
            paths.append(Path(uri, deletions.path(fragment.id)))
            check_deletions(paths[-1], deletions)
    flush_files(uri, paths)


def flush_files(uri: str, files: Iterable[Path]) -> None:
    """Flushes files of a table and the folders that hold them."""
    if not is_local(uri):
        return
    files = list(files)
    for file in files:
        flush(file)
    for folder in {parent for file in files for parent in (file.parent, Path(uri))}:
        flush(folder)


def check_data(path: Path, file: DataFile) -> None:
    """Raises OSError unless a data file has the size that Lance recorded."""
    if file.file_size_bytes and path.stat().st_size != file.file_size_bytes:
        raise _truncated(path)


def check_deletions(path: Path, file: DeletionFile) -> None:
    """Raises OSError unless a file of deleted rows holds the number of rows that Lance recorded."""
    is_whole = _is_whole_bitmap if path.suffix == ".bin" else _is_whole_array
    if not is_whole(path, file.num_deleted_rows):
        raise _truncated(path)


def _is_whole_array(path: Path, rows: int) -> bool:
    """Whether an Arrow file holds ``rows`` rows."""
    try:
        return bool(pa.ipc.open_file(path.read_bytes()).read_all().num_rows == rows)
    except pa.ArrowInvalid:
        return False


def _is_whole_bitmap(path: Path, rows: int) -> bool:
    """Whether a Roaring bitmap without runs (RoaringFormatSpec) holds ``rows`` rows."""
    content = path.read_bytes()
    if len(content) < 8:
        return False
    cookie, containers = np.frombuffer(content, "<u4", 2).tolist()
    if cookie != _BITMAP_WITHOUT_RUNS or len(content) < 8 + 8 * containers:
        return False
    counts = np.frombuffer(content, "<u2", 2 * containers, 8)[1::2].astype(np.int64) + 1
    sizes = np.where(counts <= _ARRAY_LIMIT, 2 * counts, _BITMAP_BYTES)
    return bool(counts.sum() == rows and len(content) == 8 + 8 * containers + sizes.sum())


def _truncated(path: Path) -> OSError:
    return OSError(errno.EIO, f"{os.strerror(errno.EIO)}: not all was written", str(path))
