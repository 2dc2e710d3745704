"""Parts of the core's decisions one by one, by a library that is built of its sources."""

import ctypes
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ssrvlad_torch.native import FOLDER
from ssrvlad_torch.recognition.recognise import Confidence


@cache
def library():
    """That of ``judging.cpp``."""
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder, "judging.so")
        names = "confidence.cpp", "filter.cpp", "numbers.cpp"
        sources = [Path(__file__).with_name("judging.cpp"), *(FOLDER / name for name in names)]
        flags = ["-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", f"-I{FOLDER}"]
        subprocess.run(["g++", *flags, *sources, "-o", built], check=True)
        functions = ctypes.CDLL(str(built))
    functions.chance.restype = ctypes.c_double
    return functions


def doubles(values):
    return np.ascontiguousarray(values, np.float64)


def pointer(array):
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


class Chance(NamedTuple):
    """How an answer compares with its rivals; see `oracles.recognition.chance`."""

    chance: float
    rival: int


def chance_of(values, rows=None, matching=-1):
    numbers, rival = np.ascontiguousarray(values, np.float32), ctypes.c_int64()
    listed = None if rows is None else np.ascontiguousarray(rows, np.int64)
    assert listed is None or listed.shape == numbers.shape, "a row for each value"
    sizes = ctypes.c_int64(numbers.size), ctypes.c_int64(matching)
    chance = library().chance(pointer(numbers), pointer(listed), *sizes, ctypes.byref(rival))
    return Chance(chance, rival.value)


def mapped(chances, together):
    numbers, has = doubles(chances), np.empty(len(chances))
    settings = ctypes.c_int64(numbers.size), ctypes.c_double(together)
    library().mapped(pointer(numbers), *settings, pointer(has))
    return has


def mapped_along(nearer, together):
    numbers, lengths, has = doubles(nearer), doubles(together), np.empty(len(nearer))
    size = ctypes.c_int64(numbers.size)
    library().mapped_along(pointer(numbers), pointer(lengths), size, pointer(has))
    return has


def confidence(chances, mapped, together, followed=False):
    numbers, has = doubles(chances), doubles(mapped)
    sure = np.empty((2, numbers.size), np.float32)
    settings = ctypes.c_int64(numbers.size), ctypes.c_double(together), int(followed)
    library().confidence(pointer(numbers), pointer(has), *settings, *map(pointer, sure))
    return sure


def of_chances(chances, together):
    """What the core says of queries that are judged alone."""
    sure = confidence(chances, mapped(chances, together), together)
    err = torch.where(torch.as_tensor(chances).isnan(), 0.0, float(together)).float()
    return Confidence(*map(torch.from_numpy, sure), err)


def rivals_together(chances, rivals):
    numbers, rows = doubles(chances), np.ascontiguousarray(rivals, np.int64)
    together, size = np.empty(len(rivals)), ctypes.c_int64(numbers.size)
    library().together(pointer(numbers), pointer(rows), size, pointer(together))
    return together
