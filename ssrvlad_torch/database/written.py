"""Whether files that Lance wrote are whole: a write that failed does not always reach it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

if TYPE_CHECKING:
    from lance.fragment import DataFile, DeletionFile

_NO_RUNS = 12346
_ARRAY_LIMIT, _BITMAP_BYTES = 4096, 8192


def check_data(path: Path, file: DataFile) -> None:
    """A data file has the size that Lance noted.

    Raises:
        OSError: it has not.
    """
    if file.file_size_bytes and path.stat().st_size != file.file_size_bytes:
        raise _cut_off(path)


def check_deletions(path: Path, file: DeletionFile) -> None:
    """A file of deleted rows holds as many as Lance noted.

    Raises:
        OSError: it does not.
    """
    is_whole = _is_whole_bitmap if path.suffix == ".bin" else _is_whole_array
    if not is_whole(path, file.num_deleted_rows):
        raise _cut_off(path)


def _is_whole_array(path: Path, rows: int) -> bool:
    """Of an Arrow file."""
    try:
        return bool(pa.ipc.open_file(path.read_bytes()).read_all().num_rows == rows)
    except pa.ArrowInvalid:
        return False


def _is_whole_bitmap(path: Path, rows: int) -> bool:
    """Of a Roaring bitmap without runs, as its format specification has it."""
    content = path.read_bytes()
    if len(content) < 8:
        return False
    cookie, containers = np.frombuffer(content, "<u4", 2).tolist()
    if cookie != _NO_RUNS or len(content) < 8 + 8 * containers:
        return False
    counts = np.frombuffer(content, "<u2", 2 * containers, 8)[1::2].astype(np.int64) + 1
    sizes = np.where(counts <= _ARRAY_LIMIT, 2 * counts, _BITMAP_BYTES)
    return bool(counts.sum() == rows and len(content) == 8 + 8 * containers + sizes.sum())


def _cut_off(path: Path) -> OSError:
    return OSError(errno.EIO, f"{os.strerror(errno.EIO)}: not all was written", str(path))
