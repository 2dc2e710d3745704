"""Files from elsewhere: read up to a bound and turned into plain values, or refused in one line.

Whatever a parser raises on damaged or hostile bytes becomes an `InputError` that names the file.
"""

from __future__ import annotations

import io
import json
import math
import os
import stat
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from numpy.lib import format as npy

from .files import one_line

MOST_YAML = 1 << 20
"""Bytes of a YAML file."""

_MOST_BYTES = 256 << 20
_MOST_PIXELS = 64_000_000
_MOST_LEVELS = 20


class InputError(ValueError):
    """Something in a file from elsewhere is not what it should be."""


def check_regular(path: str | os.PathLike[str]) -> None:
    """Checks that a path, or what it links to, is a file on a disk: a pipe can make a reader wait
    for ever, and a device never ends.

    Raises:
        InputError: it is a folder, a pipe, a socket or a device.
        OSError: there is no such file.
    """
    mode = Path(path).stat().st_mode
    if not stat.S_ISREG(mode):
        kind = next(name for is_kind, name in _KINDS if is_kind(mode))
        raise InputError(f"{os.fspath(path)} is {kind}; expected a file")


def read_bytes(path: str | os.PathLike[str], most: int | None = None) -> bytes:
    """The content of a file.

    Args:
        path: the file.
        most: bytes that it may have; ``None``: 256 MiB, or what the environment variable
            ``SSRVLAD_FILE_LIMIT`` says.

    Raises:
        InputError: it is larger, or no file.
        OSError: it cannot be read.
    """
    check_regular(path)
    with Path(path).open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        check_size(size, path, most)
        return file.read(size)


def check_size(size: int, name: object, most: int | None = None) -> None:
    """Checks how many bytes something has before they are in memory; ``most`` as for `read_bytes`.

    Raises:
        InputError: it has more.
    """
    limit = most or _limit("SSRVLAD_FILE_LIMIT", _MOST_BYTES)
    if size > limit:
        hint = "" if most else " (SSRVLAD_FILE_LIMIT)"
        raise InputError(f"{name} has {size} bytes; expected at most {limit}{hint}")


def read_text(path: str | os.PathLike[str], most: int | None = None) -> str:
    """The text of a UTF-8 file, with or without a byte-order mark; otherwise as `read_bytes`."""
    with naming(path, "no UTF-8 text"):
        return read_bytes(path, most).decode("utf-8-sig")


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """The document in a YAML file of at most 1 MiB; see `parse_yaml`."""
    return parse_yaml(read_text(path, MOST_YAML), path)


def parse_yaml(text: str, name: object) -> Any:
    """A YAML document as plain values.

    Raises:
        InputError: it is no YAML, is nested too deeply, or has aliases, by which a short text can
            stand for a huge one.
    """
    with naming(name, "no plain YAML"):
        return yaml.load(text, _PlainLoader)


def read_json(path: str | os.PathLike[str]) -> Any:
    """The value in a JSON file; see `parse_json`."""
    return parse_json(read_text(path), path)


def parse_json(text: str, name: object) -> Any:
    """A JSON value.

    Raises:
        InputError: it is no JSON, or is nested too deeply.
    """
    with naming(name, "not JSON"):
        return json.loads(text)


def parse_npy(content: bytes) -> npt.NDArray[Any]:
    """The array in the content of a ``.npy`` file.

    Raises:
        InputError: it is damaged, holds Python objects, or its header promises another number of
            bytes than there are.
    """
    file = io.BytesIO(content)
    shape, _, dtype = npy_header(file)
    promised, there = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if dtype.hasobject:
        raise InputError("holds Python objects; expected numbers")
    if promised != there:
        raise InputError(f"has {there} bytes for an array of shape {shape} {dtype}")
    return npy.read_array(io.BytesIO(content), allow_pickle=False)


def npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and dtype that the header of a ``.npy`` file gives; the file stands behind it.

    Raises:
        ValueError: it is damaged.
    """
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version[0] == 1 else npy.read_array_header_2_0
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(file)
    return header


def read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays in a ``.npz`` archive by name, together no larger than a file may be.

    Raises:
        InputError: it is damaged, too large, or holds Python objects.
    """
    with naming(path, "no .npz archive"), zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
        entries = archive.infolist()
        check_size(sum(entry.file_size for entry in entries), f"what is in {path}")
        return {e.filename.removesuffix(".npy"): parse_npy(archive.read(e)) for e in entries}


def check_pixels(height: int, width: int) -> None:
    """Checks the size of a picture before its pixels are in memory: a small file may hold many.

    Raises:
        InputError: more than 64 million pixels, or than the environment variable
            ``SSRVLAD_PIXEL_LIMIT`` says.
    """
    most = _limit("SSRVLAD_PIXEL_LIMIT", _MOST_PIXELS)
    if height * width > most:
        raise InputError(
            f"has {height} x {width} pixels; expected at most {most} (SSRVLAD_PIXEL_LIMIT)"
        )


def _limit(name: str, default: int) -> int:
    """What an environment variable allows."""
    text = os.environ.get(name) or str(default)
    if not text.isdecimal():
        raise InputError(f"the environment variable {name} is {text!r}; expected a whole number")
    return int(text)


@contextmanager
def naming(name: object, problem: str) -> Iterator[None]:
    """Whatever the body raises becomes an `InputError`: the name, the problem, the reason.

    An `InputError` and an `OSError` pass as they are.
    """
    try:
        yield
    except (InputError, OSError):
        raise
    except Exception as error:  # what parsers raise on damaged bytes has no bounds
        reason = "nested too deeply" if isinstance(error, RecursionError) else one_line(error)
        raise InputError(f"{name} is {problem}: {reason}") from error


class _PlainLoader(yaml.SafeLoader):
    """Refuses aliases, and more levels than settings and label spaces need."""

    _level = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        line = self.peek_event().start_mark.line + 1
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias in line {line}; expected YAML without aliases")
        if self._level == _MOST_LEVELS:
            raise yaml.YAMLError(f"more than {_MOST_LEVELS} levels in line {line}")
        self._level += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self._level -= 1
        return node


_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (lambda _: True, "no regular file"),
)
