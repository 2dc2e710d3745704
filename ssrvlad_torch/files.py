"""Files that are written whole or not at all, folders, and errors in one line."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_output(path: Path) -> Path:
    """The file that something may be written to: ``path``, or what it links to.

    Raises:
        OSError: a folder, a device or a pipe is there, or there is no such folder; with the name
            that was given.
    """
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder")
    if path.exists() and not path.is_file():
        raise OSError(f"cannot write {path}: it is no regular file")
    target = path.resolve() if path.is_symlink() else path
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {target.parent}")
    return target


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file that takes the place of ``path``, whole and on the disk, or not at all.

    The file is flushed to the disk, renamed, and the folder flushed, in this order. Where the
    folder cannot be flushed, what was there takes its place again. The temporary file's name
    starts with a dot and the name of ``path``. A link stays a link; what it leads to is replaced.

    Raises:
        OSError: nothing can be written there, see `check_output`, or the disk refused; with the
            name of the file. What was there is as it was.
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
            _put_back(before, target)
            raise
    except OSError as error:
        if error.filename in (str(temporary), temporary) or (
            error.errno in _FULL and error.filename is None
        ):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        temporary.unlink(missing_ok=True)
        before.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Has the disk take what was written to a file or, where the system can, a folder.

    Raises:
        OSError: the disk refused.
    """
    if os.name != "posix" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def empty_folder(path: Path) -> Path:
    """A folder without anything in it, made if it is missing.

    Raises:
        ValueError: something is in it.
        OSError: it cannot be made.
    """
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise ValueError(f"{path} is not empty; expected a new or an empty folder")
    return path


def one_line(error: Exception) -> str:
    """An error in one line that is never empty; of the system's errors, what the system says."""
    reason = getattr(error, "strerror", None) or str(error)
    return " ".join(reason.split()) or type(error).__name__


def absolute_folder(folder: Path) -> Path:
    """A folder's absolute path, so that ``.`` and ``..`` too have a name and a parent.

    A symbolic link keeps the name that it was given.
    """
    path = folder.absolute()
    return path.resolve() if path.name == ".." else path


def _put_back(before: Path, path: Path) -> None:
    """Undoes a rename: what was there, or nothing."""
    if before.exists():
        before.replace(path)
    else:
        path.unlink()
