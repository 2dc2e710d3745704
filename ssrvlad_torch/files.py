"""Files from outside, read up to a size limit and parsed to plain values; files that are written
completely or not at all, figures among them; folders, and the order of names.

Whatever a parser raises on damaged or hostile bytes becomes an `InputError` that names the file."""

from __future__ import annotations

import base64
import io
import json
import math
import os
import re
import secrets
import stat
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import yaml
from natsort import natsort_keygen
from numpy.lib import format as npy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_YAML_BYTES = 1 << 20
"""Size limit of a YAML file."""

_MAX_BYTES = 256 << 20
_MAX_PIXELS = 64_000_000
_MAX_LEVELS = 20
_DECIMAL = re.compile(r"(\d+)\.(\d+)")
_DECIMALS = 20
_NATURAL: Callable[[str], Any] = natsort_keygen()
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class InputError(ValueError):
    """The content of an untrusted file is invalid."""


def path_within(folder: Path, name: object, form: str = "") -> Path:
    """The path in ``folder`` that a name means which was read from a file.

    With ``form``, a regular expression of the names that this package writes, the name is one
    component of that form, and no link. Without, a relative path that does not leave the folder.
    Any other name is an InputError."""
    text = name if isinstance(name, str) and "\0" not in name else ""
    parts = re.split(r"[/\\]", text)
    inside = text != "" and ".." not in parts and not Path(text).anchor
    if not inside or (form and (len(parts) > 1 or not re.fullmatch(form, text))):
        raise InputError(f"expected the name of a file in {folder}, got {name!r}")
    path = folder / text
    if form and path.is_symlink():
        raise InputError(f"{path} is a link; expected a file or a folder")
    return path


def check_regular(path: str | os.PathLike[str]) -> None:
    """Raises an InputError unless a path, or the target of a link, is a regular file: reading a
    pipe can block for ever, and a device has no end. A missing file is an OSError."""
    mode = Path(path).stat().st_mode
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "not a regular file")
        raise InputError(f"{os.fspath(path)} is {kind}; expected a file")


def read_bytes(path: str | os.PathLike[str], limit: int | None = None) -> bytes:
    """The content of a regular file of at most ``limit`` bytes, by default the environment variable
    ``SSRVLAD_FILE_LIMIT``, or 256 MiB. Another file is an InputError, a missing one an OSError."""
    check_regular(path)
    with Path(path).open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        check_size(size, path, limit)
        return file.read(size)


def check_size(size: int, name: object, limit: int | None = None) -> None:
    """Refuses a size in bytes above the limit of `read_bytes` by an InputError."""
    hint = "" if limit else " (SSRVLAD_FILE_LIMIT)"
    limit = limit or _limit("SSRVLAD_FILE_LIMIT", _MAX_BYTES)
    if size > limit:
        raise InputError(f"{name} has {size} bytes; expected at most {limit}{hint}")


def read_text(path: str | os.PathLike[str], limit: int | None = None) -> str:
    """The text of a UTF-8 file, with or without a byte-order mark; arguments as `read_bytes`."""
    with input_errors(path, "not UTF-8 text"):
        return read_bytes(path, limit).decode("utf-8-sig")


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """The document in a YAML file of at most 1 MiB; see `parse_yaml`."""
    return parse_yaml(read_text(path, MAX_YAML_BYTES), path)


def parse_yaml(text: str, name: object) -> Any:
    """A YAML document as plain values. Other text, deep nesting, and aliases, with which a short
    text can expand to a huge one, are an InputError."""
    with input_errors(name, "not plain YAML"):
        return yaml.load(text, _PlainLoader)


def read_json(path: str | os.PathLike[str]) -> Any:
    """The value in a JSON file; see `parse_json`."""
    return parse_json(read_text(path), path)


def parse_json(text: str, name: object) -> Any:
    """A JSON value; other text, a key twice, and deep nesting are an InputError."""
    with input_errors(name, "not JSON"):
        return json.loads(text, object_pairs_hook=_without_repeated_keys)


def _without_repeated_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        (key, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"key {key!r} is there more than once")
    return mapping


def parse_npy(content: bytes) -> npt.NDArray[Any]:
    """The array in the content of a ``.npy`` file; damage, Python objects, and a length that does
    not fit the header are an InputError."""
    file = io.BytesIO(content)
    shape, _, dtype = npy_header(file)
    expected, size = math.prod(shape) * dtype.itemsize, len(content) - file.tell()
    if dtype.hasobject:
        raise InputError("holds Python objects; expected numbers")
    if size != expected:
        raise InputError(f"has {size} bytes for an array of shape {shape} {dtype}")
    return npy.read_array(io.BytesIO(content), allow_pickle=False)


def npy_bytes(array: npt.NDArray[Any]) -> bytes:
    """The content of a ``.npy`` file of an array of numbers."""
    file = io.BytesIO()
    npy.write_array(file, array, allow_pickle=False)
    return file.getvalue()


def npy_header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and dtype of a ``.npy`` header, read up to its end; or ValueError."""
    version = npy.read_magic(file)
    read = npy.read_array_header_1_0 if version[0] == 1 else npy.read_array_header_2_0
    header: tuple[tuple[int, ...], bool, np.dtype[Any]] = read(file)
    return header


def read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays in a ``.npz`` archive by name. Damage, Python objects, and a total size above the
    limit of `read_bytes` are an InputError."""
    with input_errors(path, "not a .npz archive"):
        archive = zipfile.ZipFile(io.BytesIO(read_bytes(path)))
        entries = archive.infolist()
        check_size(sum(entry.file_size for entry in entries), f"the content of {path}")
        return {e.filename.removesuffix(".npy"): parse_npy(archive.read(e)) for e in entries}


def check_pixels(height: int, width: int) -> None:
    """Raises an InputError for a picture of more pixels than the environment variable
    ``SSRVLAD_PIXEL_LIMIT``, or 64 million, before it is decoded: a small file can hold many."""
    limit = _limit("SSRVLAD_PIXEL_LIMIT", _MAX_PIXELS)
    if height * width > limit:
        raise InputError(
            f"has {height} x {width} pixels; expected at most {limit} (SSRVLAD_PIXEL_LIMIT)"
        )


def _limit(name: str, default: int) -> int:
    """The value of an environment variable, or a default."""
    text = os.environ.get(name) or str(default)
    if not text.isdecimal():
        raise InputError(f"the environment variable {name} is {text!r}; expected a whole number")
    return int(text)


@contextmanager
def requiring(extra: str, needs: str) -> Iterator[None]:
    """Turns an ImportError of the body into one that names the extra: "NEEDS: pip install ..."."""
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{needs}: pip install ssrvlad-torch[{extra}]") from error


@contextmanager
def naming(place: object) -> Iterator[None]:
    """Turns whatever the body raises into a ValueError of one line, "PLACE: REASON". An OSError or
    an ImportError passes unchanged."""
    try:
        yield
    except (OSError, ImportError):
        raise
    except Exception as error:  # parsers raise anything on damaged bytes
        raise ValueError(f"{place}: {one_line(error)}") from error


@contextmanager
def input_errors(name: object, problem: str) -> Iterator[None]:
    """Turns whatever the body raises into an `InputError`: "NAME is PROBLEM: REASON". An
    `InputError` or an `OSError` passes unchanged."""
    try:
        yield
    except (InputError, OSError):
        raise
    except Exception as error:  # parsers raise anything on damaged bytes
        reason = "nested too deeply" if isinstance(error, RecursionError) else one_line(error)
        raise InputError(f"{name} is {problem}: {reason}") from error


def check_output(path: Path) -> Path:
    """The file to write for an output path: ``path``, or the target of a link. A folder, a device
    or a pipe, and a path whose folder does not exist, are an OSError with ``path`` as given."""
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

    The file is flushed to disk, renamed, and the folder is flushed, in this order. The temporary
    file's name starts with a dot and the name of ``path``. A link stays a link; its target is
    replaced. An error of the disk is an OSError with the name of the file."""
    target = check_output(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        yield temporary
        flush(temporary)
        temporary.replace(target)
        flush(target.parent)
    except OSError as error:
        if error.errno and error.filename in (None, str(temporary), temporary):
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)


def flush(path: Path) -> None:
    """Flushes a file to disk, or, on POSIX systems, a folder; an error is an OSError."""
    if os.name != "posix" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def require_picture(path: Path) -> None:
    """Raises the errors of `write_picture` before the picture is drawn: an ImportError without
    matplotlib, a ValueError for a format that it does not write, an OSError as `check_output`."""
    formats = new_figure(1, 1).canvas.get_supported_filetypes()
    if _format(path) not in formats:
        raise ValueError(f"{path}: a picture is one of {', '.join(formats)}")
    check_output(path)


def write_picture(figure: Figure, path: Path) -> None:
    """Writes a figure whole or not at all, by its suffix or as PNG; see `require_picture`."""
    require_picture(path)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=_format(path))


def printable(text: object) -> str:
    """A text in one line for terminals and pictures: unprintable characters, such as a newline in
    the name of a file, are escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def drawn_text(text: object) -> str:
    """A text for matplotlib, which draws it as it is: `printable`, and ``$`` begins no formula."""
    return printable(text).replace("$", r"\$")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure; width and height in inches. Without matplotlib it is an ImportError."""
    with requiring("eval", "pictures need"):
        from matplotlib.figure import Figure
    return Figure(figsize=(width, height), layout="constrained")


def png_address(save: Callable[[io.BytesIO], object]) -> str:
    """The address, for HTML, of a PNG that ``save`` writes to a file."""
    content = io.BytesIO()
    save(content)
    return f"data:image/png;base64,{base64.b64encode(content.getvalue()).decode()}"


def _format(path: Path) -> str:
    return path.suffix.removeprefix(".").lower() or "png"


def is_uri(path: str) -> bool:
    """Whether a path is a URI, of an object store for example, and not of a local disk."""
    return "://" in path


def empty_folder(path: Path) -> Path:
    """An empty folder, created if it is missing; one that is not empty is a ValueError."""
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise ValueError(f"{path} is not empty; expected a new or an empty folder")
    return path


def one_line(error: Exception) -> str:
    """An error in one line that is never empty; for a system error, the system's message."""
    reason = getattr(error, "strerror", None) or str(error)
    return " ".join(reason.split()) or type(error).__name__


def natural_key(name: str) -> tuple[Any, str]:
    """Sort key of natural order: ``frame10`` after ``frame9``, and ``1`` after ``01``. A name that
    is a decimal number counts by its value: ``12.5`` after ``12.25``."""
    decimal = _DECIMAL.fullmatch(name)
    text = f"{decimal[1]}.{decimal[2]:0<{_DECIMALS}}" if decimal else name
    return _NATURAL(text), name


class _PlainLoader(yaml.SafeLoader):
    """Refuses aliases and deep nesting."""

    _level = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        line = self.peek_event().start_mark.line + 1
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"an alias in line {line}; expected YAML without aliases")
        if self._level == _MAX_LEVELS:
            raise yaml.YAMLError(f"more than {_MAX_LEVELS} levels in line {line}")
        self._level += 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self._level -= 1
        return node
