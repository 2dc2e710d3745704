"""The native core: the method and the decisions in C++ without torch; the method as its operator.

It is built with the package if a C++ compiler is available, and describes label maps on a CPU.
Without it, and on other devices, the stages in torch compute the same numbers.
"""

import ctypes
import hashlib
import sys
import warnings
from functools import cache
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).parent
LIBRARY = "libssrvlad" + {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")

_SIZE, _POINTER = ctypes.c_int64, ctypes.c_void_p


class Settings(ctypes.Structure):
    """``ssrvlad_settings`` of ssrvlad.h."""

    _fields_ = tuple(
        (name, kind)
        for kind, names in (
            (ctypes.c_double, "opening closing hole_area region_area radius inner_radius"),
            (ctypes.c_double, "spectral_weight power"),
            (ctypes.c_int32, "working_size rings sectors harmonics boundary_harmonics"),
            (ctypes.c_int32, "thinning context aggregation anchor"),
        )
        for name in names.split()
    )


class Table(ctypes.Structure):
    """``ssrvlad_table`` of ssrvlad.h."""

    _fields_ = (("categories", _POINTER), ("entries", _SIZE), ("origin", _SIZE))


class Labels(ctypes.Structure):
    """``ssrvlad_labels`` of ssrvlad.h."""

    _fields_ = (
        *(("ids", _POINTER), ("bytes", ctypes.c_int32)),
        *(("images", _SIZE), ("height", _SIZE), ("width", _SIZE)),
    )


class Core(NamedTuple):
    """The loaded library, or ``None``; ``status`` says what computes descriptors, and why."""

    library: ctypes.CDLL | None
    status: str


def required() -> ctypes.CDLL:
    """The library; without it a RuntimeError says why."""
    library, status = core()
    if library is None:
        raise RuntimeError(status.removeprefix("torch, for "))
    return library


def if_built(task: str) -> ctypes.CDLL | None:
    """The library; without it ``None``, and a UserWarning says once that NumPy does a task."""
    library, status = core()
    if library is None:
        _warn(f"NumPy {task}, slowly, {status.removeprefix('torch, ')}")
    return library


@cache
def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=4)


@cache
def core() -> Core:
    """Loads the native core, unless it was built from another version of the C++ files."""
    path = FOLDER / LIBRARY
    if not path.exists():
        return Core(None, "torch, for the native core was not built")
    files = sorted(file for file in FOLDER.iterdir() if file.suffix in (".cpp", ".h", ".hpp"))
    source = b"".join(file.read_bytes() for file in files)
    if hashlib.sha256(source).hexdigest().encode() not in path.read_bytes():
        return Core(None, "torch, for the native core is of another version: install again")
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return Core(None, f"torch, for the native core cannot be loaded: {error}")
    size, pointer, planes = _SIZE, _POINTER, (_POINTER, _SIZE, _SIZE, _SIZE)
    maps = (ctypes.POINTER(Labels), ctypes.POINTER(Table))
    library.ssrvlad_new.restype = pointer
    library.ssrvlad_describe.restype = library.ssrvlad_vote.restype = size
    library.ssrvlad_new.argtypes = [ctypes.POINTER(Settings)]
    library.ssrvlad_free.argtypes = [pointer]
    library.ssrvlad_describe.argtypes = [pointer, *maps, ctypes.c_int, pointer]
    library.ssrvlad_vote.argtypes = [*maps, size, size, pointer]
    library.ssrvlad_scan_signs.argtypes = [
        *(pointer, size, pointer, size, size, size, size, size, ctypes.c_int, pointer)
    ]
    library.ssrvlad_scan_vectors.argtypes = [
        *(pointer, pointer, size, size, pointer, size, size, ctypes.c_int, pointer)
    ]
    library.ssrvlad_open_and_close.argtypes = [*planes, size, size, pointer]
    library.ssrvlad_fill_holes.argtypes = [*planes, size, pointer]
    library.ssrvlad_drop_regions.argtypes = [*planes, size, pointer]
    library.ssrvlad_thin.argtypes = [*planes, ctypes.c_int, pointer]
    library.ssrvlad_keypoints.argtypes = [*planes, pointer, pointer]
    return Core(library, "the native core")
