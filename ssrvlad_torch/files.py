"""Files that are written whole or not at all, and the names of folders."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file that takes the place of ``path``, whole and on the disk, or not at all.

    The file is flushed to the disk, renamed, and the folder flushed, in this order.

    Raises:
        OSError: the disk refused; what was at ``path`` is as it was.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(path)
        _flush(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def absolute_folder(folder: Path) -> Path:
    """A folder's absolute path, so that ``.`` and ``..`` too have a name and a parent.

    A symbolic link keeps the name that it was given.
    """
    path = folder.absolute()
    return path.resolve() if path.name == ".." else path


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
