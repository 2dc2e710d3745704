"""Files that are written completely or not at all, folders, and one-line error messages."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_output(path: Path) -> Path:
    """The file to write for an output path: ``path``, or the target of a link.

    Raises:
        OSError: ``path`` is a folder, a device or a pipe, or its folder does not exist. The message
            has ``path`` as it was given.
    """
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    if path.exists() and not path.is_file():
        raise OSError(f"cannot write {path}: it is not a regular file")
    target = path.resolve() if path.is_symlink() else path
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {target.parent}")
    return target


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file that replaces ``path`` at the end of the block, not after an error.

    The file is flushed to disk, renamed, and the folder is flushed, in this order. If the folder
    cannot be flushed, the old file is restored. The temporary file's name starts with a dot and
    the name of ``path``. A link stays a link; its target is replaced.

    Raises:
        OSError: ``path`` cannot be written, see `check_output`, or the disk reports an error; with
            the name of the file. The old file is unchanged.
    """
    target = check_output(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.{secrets.token_hex(4)}")
    before = temporary.with_name(f"{temporary.name}.before")
    try:
        yield temporary
        flush(temporary)
        if target.exists():
            before.hardlink_to(target)
        temporary.replace(target)
        try:
            flush(target.parent)
        except OSError:
            _restore(before, target)
            raise
    except OSError as error:
        if error.filename in (str(temporary), temporary) or (
            error.errno in _FULL and error.filename is None
        ):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)
        before.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Flushes a file to disk, or, on POSIX systems, a folder.

    Raises:
        OSError: the disk reports an error.
    """
    if os.name != "posix" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def empty_folder(path: Path) -> Path:
    """An empty folder, created if it is missing.

    Raises:
        ValueError: the folder is not empty.
        OSError: the folder cannot be created.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise ValueError(f"{path} is not empty; expected a new or an empty folder")
    return path


def one_line(error: Exception) -> str:
    """An error in one line that is never empty; for a system error, the system's message."""
    reason = getattr(error, "strerror", None) or str(error)
    return " ".join(reason.split()) or type(error).__name__


def absolute_folder(folder: Path) -> Path:
    """A folder's absolute path, so that ``.`` and ``..`` have a name and a parent too.

    A symbolic link keeps its own name.
    """
    path = folder.absolute()
    return path.resolve() if path.name == ".." else path


def _restore(before: Path, path: Path) -> None:
    """Undoes a rename: restores the old file, or removes the new one if there was none."""
    if before.exists():
        before.replace(path)
    else:
        path.unlink()
