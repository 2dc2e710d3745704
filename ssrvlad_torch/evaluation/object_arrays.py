"""Reads pickles of arrays, lists and mappings without running code from the file.

A pickle is a program: NumPy's ``allow_pickle=True`` calls any function that the file names. Here
the few names that such files need are replaced by stand-ins, and any other name is an error.
NumPy's ``__setstate__`` is not called either, because it trusts its arguments.
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
_MEMO_OPCODES = ("PUT", "BINPUT", "LONG_BINPUT")


def load_object_array(file: BinaryIO) -> PickledArray:
    """The pickled array at the position of a file; ``numpy.save`` writes one after the header of a
    ``.npy`` file of objects. Errors as for `load_pickle`; another content is a ValueError too."""
    loaded = load_pickle(file)
    if not isinstance(loaded, PickledArray):
        raise ValueError(f"expected a pickled array, got a {type(loaded).__name__}")
    return loaded


def load_pickle(file: BinaryIO) -> Any:
    """The content of the pickle at the position of a file: numbers, text, lists, tuples and
    mappings; a `PickledArray` for an array; a `PickledObject` for an object of scikit-learn, with
    its attributes only. A damaged pickle, and one of another type, which the message names, is a
    ValueError."""
    try:
        _check_memo(file)
        return _Unpickler(file, encoding="latin1").load()
    except _Forbidden as error:
        raise ValueError(
            f"it refers to {error}; expected only arrays, lists, mappings and numbers"
        ) from error
    except Exception as error:  # damaged pickles raise any exception
        raise ValueError(f"it is no complete pickle: {one_line(error)}") from error


def _check_memo(file: BinaryIO) -> None:
    """Raises a ValueError for a memo index larger than the number of bytes before it: the unpickler
    would allocate memory for all smaller indices."""
    begin = file.tell()
    for opcode, argument, _ in pickletools.genops(file):
        if opcode.name in _MEMO_OPCODES and (argument or 0) > file.tell():
            raise ValueError(f"memo index {argument} at byte {file.tell()}")
    file.seek(begin)


class PickledObject:
    """Stand-in for an object: its attributes, without methods."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class PickledArray:
    """Stand-in for a pickled array: its shape, and its elements in C order, numbers or objects.
    Iterating gives its rows, each as a flat list."""

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
        """The values as a NumPy array of numbers."""
        return np.array(self.values).reshape(self.shape)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, fortran, content = state
        of_objects = kind.name.startswith("O")
        values = content if of_objects else kind.numbers(content)
        if not isinstance(values, list) or len(values) != math.prod(shape) or not shape:
            raise ValueError(f"the content of an array does not fit its shape {shape}")
        if fortran and not of_objects:  # NumPy always writes objects in C order
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
        """Numbers from bytes, or from text, as Python 2 pickled bytes."""
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
"""Names that pickles of arrays, lists and mappings contain, and their stand-ins."""


class _Forbidden(pickle.UnpicklingError):
    """The pickle contains a name that arrays, lists and mappings do not need."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        """A stand-in, new for each call because a pickle can set its attributes."""
        module = module.replace("numpy._core", "numpy.core").replace("__builtin__", "builtins")
        stand_in = _STAND_INS.get(f"{module.replace('copy_reg', 'copyreg')}.{name}")
        if stand_in is not None:
            return lambda *arguments: stand_in(*arguments)  # noqa: PLW0108 - new each time
        if module.partition(".")[0] == "sklearn" or module.startswith("numpy.random"):
            return type("PickledObject", (PickledObject,), {})
        raise _Forbidden(f"{module}.{name}")
