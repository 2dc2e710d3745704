"""Pickled NumPy arrays of objects, read without running what a pickle asks for.

A pickle is a program: NumPy's own ``allow_pickle=True`` calls whatever function the file names.
Here the few names that an array of numbers and lists needs lead to stand-ins of this module, and
any other name is refused. Not even NumPy's own ``__setstate__`` is called, since it trusts what it
is given.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np

_NUMBERS = "biuf"


def load_object_array(file: BinaryIO) -> PickledArray:
    """The pickled array at a file's position.

    Reads what ``numpy.save`` wrote of an array of objects, in Python 2 and 3, by protocols 0 to 4,
    after the header of the ``.npy`` file.

    Returns:
        its elements, which are numbers, lists, tuples and arrays, nested as in the file; what
        else a pickle holds without asking for a name (text, mappings) is left as it is.

    Raises:
        ValueError: the pickle asks for anything but arrays, lists, tuples and numbers, in which
            case the message says for what, or it is damaged.
    """
    try:
        loaded = _Unpickler(file, encoding="latin1").load()
    except _Forbidden as error:
        raise ValueError(
            f"it asks for {error}; wanted nothing but arrays, lists, tuples and numbers"
        ) from error
    except Exception as error:  # what a damaged pickle raises has no bounds
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"it is no pickled array: {reason}") from error
    if not isinstance(loaded, PickledArray):
        raise ValueError(f"wanted a pickled array, got a {type(loaded).__name__}")
    return loaded


class PickledArray:
    """Stand-in for a pickled array.

    It is iterated over its first axis; of an array of rank 2 or more each step gives the elements
    of that row as a flat list.

    Attributes:
        shape: of the array.
        values: the elements in C order: numbers, or what else an array of objects holds.
    """

    __slots__ = ("shape", "values")

    def __init__(self) -> None:
        self.shape: tuple[int, ...] = (0,)
        self.values: list[Any] = []

    def __iter__(self) -> Iterator[Any]:
        if len(self.shape) == 1:
            return iter(self.values)
        width = math.prod(self.shape[1:])
        return (self.values[row * width : (row + 1) * width] for row in range(len(self)))

    def __len__(self) -> int:
        return self.shape[0]

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, fortran, content = state
        of_objects = kind.name.startswith("O")
        values = content if of_objects else kind.numbers(content)
        if not isinstance(values, list) or len(values) != math.prod(shape) or not shape:
            raise ValueError(f"an array of shape {shape} does not hold what it should")
        if fortran and not of_objects:  # NumPy lists objects in C order all the same
            values = np.reshape(values, shape, order="F").ravel().tolist()
        self.shape, self.values = tuple(shape), values


class _Kind:
    """Stand-in for a pickled ``numpy.dtype``."""

    __slots__ = ("name", "order")

    def __init__(self, name: str) -> None:
        self.name, self.order = name, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1].replace("|", "=")

    def numbers(self, content: str | bytes) -> list[Any]:
        """The numbers that some bytes are; Python 2 pickled them as text."""
        dtype = np.dtype(self.order + self.name)
        if dtype.kind not in _NUMBERS:
            raise _Forbidden(f"numpy.dtype({self.name!r})")
        content = content.encode("latin1") if isinstance(content, str) else content
        numbers: list[Any] = np.frombuffer(content, dtype).tolist()
        return numbers


class _Forbidden(pickle.UnpicklingError):
    """The pickle asks for a name that no array of numbers and lists needs."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        """A new function each time: a pickle can set attributes of what it gets."""
        match f"{module.replace('numpy._core', 'numpy.core')}.{name}":
            case "numpy.core.multiarray._reconstruct" | "numpy.ndarray":
                return lambda *_: PickledArray()
            case "numpy.core.multiarray.scalar":
                return lambda kind, content: kind.numbers(content)[0]
            case "numpy.dtype":
                return lambda name, *_: _Kind(name)
            case "_codecs.encode":
                return lambda text, _: text.encode("latin1")
        raise _Forbidden(f"{module}.{name}")
