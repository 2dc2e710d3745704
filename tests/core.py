"""Functions of the decision core that the package does not call by themselves."""

import ctypes
from typing import NamedTuple

import numpy as np
import torch

from ssrvlad_torch.native import required
from ssrvlad_torch.recognition.confidence import Confidence


class Chance(NamedTuple):
    """How an answer compares with its rivals; see `reference.chance`."""

    chance: float
    rival: int


def chance_of(values, rows=None, count=-1):
    numbers, found, rival = (
        np.ascontiguousarray(values, np.float64),
        ctypes.c_double(),
        ctypes.c_int64(),
    )
    some = None if rows is None else np.ascontiguousarray(rows, np.int64)
    assert some is None or some.shape == numbers.shape, "a row for each value"
    given = (
        numbers.ctypes,
        None if some is None else some.ctypes,
        numbers.size,
        count,
        ctypes.byref(found),
        ctypes.byref(rival),
    )
    assert required().ssrvlad_chance(*given) == 0
    return Chance(found.value, rival.value)


def mapped(chances, together, best=1.0):
    numbers, found = np.ascontiguousarray(chances, np.float64), np.empty(len(chances))
    given = numbers.ctypes, numbers.size, together, best, found.ctypes
    assert required().ssrvlad_mapped(*given) == 0
    return found


def confidence(chances, mapped, together, followed=False):
    numbers, places = (np.ascontiguousarray(each, np.float64) for each in (chances, mapped))
    found = np.empty((2, numbers.size), np.float32)
    given = numbers.ctypes, places.ctypes, numbers.size, together, followed
    assert required().ssrvlad_confidence(*given, *(each.ctypes for each in found)) == 0
    return found


def of_chances(chances, together):
    """What the core says of queries that are judged alone."""
    sure = confidence(chances, mapped(chances, together), together)
    err = torch.where(torch.as_tensor(chances).isnan(), 0.0, float(together)).float()
    return Confidence(*map(torch.from_numpy, sure), err)


def answers_together(rivals):
    rows = np.ascontiguousarray(rivals, np.int64)
    return required().ssrvlad_together(rows.ctypes, rows.size)
