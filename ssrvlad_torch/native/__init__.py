"""The native core: the method and the decisions in C++ without torch; the method as its operator.

On other devices than a CPU the stages in torch compute the same descriptors.
"""

import ctypes
import hashlib
import sys
from functools import cache
from typing import NamedTuple

from .headers import FOLDER, typed

LIBRARY = "libssrvlad" + {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")

BUILD = "install the package again, in a checkout run python scripts/hatch_build.py"


class Core(NamedTuple):
    """The loaded library, or ``None``; ``status`` names its SIMD, or says how to build it."""

    library: ctypes.CDLL | None
    status: str


def required() -> ctypes.CDLL:
    """The library; without it a RuntimeError says how to build it."""
    library, status = core()
    if library is None:
        raise RuntimeError(status)
    return library


def last_error() -> str:
    """Why the last call of this thread failed that did."""
    address: int = required().ssrvlad_last_error()
    return ctypes.string_at(address).decode()


def failure(kind: type[Exception] = ValueError, what: str = "") -> Exception:
    """The error of the last call of this thread that failed, in the words of the core: a
    MemoryError if memory was short, else one of this kind that begins with ``what`` was
    refused."""
    reason = last_error()
    if reason == "not enough memory":
        return MemoryError(reason)
    return kind(f"{what}: {reason}" if what else reason)


def require(status: int, what: str = "") -> None:
    """Raises what a return code of the core means; see `failure`."""
    if status:
        raise failure(what=what)


@cache
def core() -> Core:
    """Loads the native core, unless it was built from another version of the C++ files."""
    path = FOLDER / LIBRARY
    files = sorted(file for file in FOLDER.iterdir() if file.suffix in (".cpp", ".h", ".hpp"))
    source = b"".join(file.read_bytes() for file in files)
    if not path.exists():
        problem = "is missing"
    elif hashlib.sha256(source).hexdigest().encode() not in path.read_bytes():
        problem = "is of another version"
    else:
        try:
            library = typed(ctypes.CDLL(str(path)))
            simd = ctypes.string_at(library.ssrvlad_simd()).decode()
            return Core(library, f"the native core ({simd})")
        except OSError as error:
            problem = f"cannot be loaded ({error})"
    return Core(None, f"the native core {problem}: {BUILD}")
