"""Pickles of arrays, lists and mappings, read without running what a pickle asks for.

A pickle is a program: NumPy's own ``allow_pickle=True`` calls any function that the file names.
Here the few names that such files need lead to stand-ins of this module, and any other name is an
error. Not even NumPy's own ``__setstate__`` is called, since it trusts what it is given.
"""

from __future__ import annotations

import math
import pickle
import pickletools
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from ..files import one_line

_NUMBERS = "biuf"
_TO_MEMO = ("PUT", "BINPUT", "LONG_BINPUT")


def load_object_array(file: BinaryIO) -> PickledArray:
    """The pickled array at a file's position, as ``numpy.save`` writes it for objects after the
    header of the ``.npy`` file.

    Raises:
        ValueError: as `load_pickle`, or the pickle holds no array.
    """
    loaded = load_pickle(file)
    if not isinstance(loaded, PickledArray):
        raise ValueError(f"expected a pickled array, got a {type(loaded).__name__}")
    return loaded


def load_pickle(file: BinaryIO) -> Any:
    """What is pickled at a file's position.

    Returns:
        numbers, text, lists, tuples and mappings; a `PickledArray` for an array; a `PickledObject`
        for an object of scikit-learn, with its attributes only.

    Raises:
        ValueError: the pickle is damaged, or asks for anything else, which the message names.
    """
    try:
        _check_memo(file)
        return _Unpickler(file, encoding="latin1").load()
    except _Forbidden as error:
        raise ValueError(
            f"it asks for {error}; expected nothing but arrays, lists, mappings and numbers"
        ) from error
    except Exception as error:  # what a damaged pickle raises has no bounds
        raise ValueError(f"it is no whole pickle: {one_line(error)}") from error


def _check_memo(file: BinaryIO) -> None:
    """Refuses a memo place that so few bytes cannot have filled: memory for all places before it
    would be taken."""
    begin = file.tell()
    for opcode, argument, _ in pickletools.genops(file):
        if opcode.name in _TO_MEMO and (argument or 0) > file.tell():
            raise ValueError(f"place {argument} of the memo at byte {file.tell()}")
    file.seek(begin)


class PickledObject:
    """Stand-in for an object: its attributes, without methods."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class PickledArray:
    """Stand-in for a pickled array. Iterating gives its rows, each as a flat list.

    Attributes:
        shape: of the array.
        values: the elements in C order: numbers, or what an array of objects holds.
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

    def numbers(self) -> npt.NDArray[Any]:
        """An array of numbers as such."""
        return np.array(self.values).reshape(self.shape)

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

    def numbers(self, content: str | bytes | bytearray) -> list[Any]:
        """The numbers that some bytes are; Python 2 pickled them as text."""
        dtype = np.dtype(self.order + self.name)
        if dtype.kind not in _NUMBERS:
            raise _Forbidden(f"numpy.dtype({self.name!r})")
        content = content.encode("latin1") if isinstance(content, str) else content
        numbers: list[Any] = np.frombuffer(content, dtype).tolist()
        return numbers


def _of_buffer(content: bytes, kind: _Kind, shape: tuple[int, ...], order: str) -> PickledArray:
    """An array of numbers as protocol 5 writes it."""
    array = PickledArray()
    array.__setstate__((1, shape, kind, order == "F", content))
    return array


_STAND_INS: dict[str, Callable[..., Any]] = {
    "numpy.core.multiarray._reconstruct": lambda *_: PickledArray(),
    "numpy.core.multiarray.scalar": lambda kind, content: kind.numbers(content)[0],
    "numpy.core.numeric._frombuffer": _of_buffer,
    "numpy.ndarray": lambda *_: PickledArray(),
    "numpy.dtype": lambda name, *_: _Kind(name),
    "_codecs.encode": lambda text, _: text.encode("latin1"),
    "collections.OrderedDict": lambda pairs=(): dict(pairs),
    "collections.defaultdict": lambda *_: {},
    "copyreg._reconstructor": lambda kind, *_: kind(),
    "builtins.list": lambda *_: [],
    "builtins.object": lambda *_: None,
}
"""What a pickle of arrays, lists and mappings may ask for, and what it gets."""


class _Forbidden(pickle.UnpicklingError):
    """The pickle asks for a name that arrays, lists and mappings do not need."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        """A new function each time: a pickle can set attributes of what it gets."""
        module = module.replace("numpy._core", "numpy.core").replace("__builtin__", "builtins")
        stand_in = _STAND_INS.get(f"{module.replace('copy_reg', 'copyreg')}.{name}")
        if stand_in is not None:
            return lambda *arguments: stand_in(*arguments)  # noqa: PLW0108 - new each time
        if module.partition(".")[0] == "sklearn" or module.startswith("numpy.random"):
            return type("PickledObject", (PickledObject,), {})
        raise _Forbidden(f"{module}.{name}")
