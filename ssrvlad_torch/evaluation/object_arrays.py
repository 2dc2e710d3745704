"""Reads pickles of arrays, lists and mappings without running code from the file.

A pickle is a program: NumPy's ``allow_pickle=True`` calls any function that the file names. Here
the few names that such files need are replaced by stand-ins, and any other name is an error. NumPy
itself cannot stand in: the ``__setstate__`` of a dtype trusts its arguments, and an array of such a
dtype can end the process.
"""

from __future__ import annotations

import math
import pickle
import pickletools
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np

from ..files import one_line


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
        begin = file.tell()
        for opcode, index, _ in pickletools.genops(file):
            # The unpickler allocates memory for all smaller indices.
            if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and (index or 0) > file.tell():
                raise ValueError(f"memo index {index} at byte {file.tell()}")
        file.seek(begin)
        return _Unpickler(file, encoding="latin1").load()
    except _Forbidden as error:
        raise ValueError(
            f"it refers to {one_line(error)}; expected only arrays, lists, mappings and numbers"
        ) from error
    except Exception as error:  # damaged pickles raise any exception
        raise ValueError(f"it is no complete pickle: {one_line(error)}") from error


class PickledObject:
    """Stand-in for an object: its attributes, without methods."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: object) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class PickledArray:
    """Stand-in for a pickled array: its shape, and its elements in C order, numbers or objects.
    Iterating gives its rows, each as a flat list."""

    def __init__(self, *state: Any) -> None:
        self.shape: tuple[int, ...] = (0,)
        self.values: list[Any] = []
        if state:
            self.__setstate__(state)

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
            raise ValueError(f"the content of an array does not fit its shape {shape}")
        if fortran and not of_objects:  # NumPy always writes objects in C order
            values = np.reshape(values, shape, order="F").ravel().tolist()
        self.shape, self.values = tuple(shape), values


class _Kind:
    """Stand-in for a pickled ``numpy.dtype``."""

    def __init__(self, name: str, *_: object) -> None:
        self.name, self.order = name, "="

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1].replace("|", "=")

    def numbers(self, content: str | bytes | bytearray) -> list[Any]:
        """Numbers from bytes, or from text, as Python 2 pickled bytes."""
        dtype = np.dtype(self.order + self.name)
        if dtype.kind not in "biuf":
            raise _Forbidden(f"numpy.dtype({self.name!r})")
        content = content.encode("latin1") if isinstance(content, str) else content
        numbers: list[Any] = np.frombuffer(content, dtype).tolist()
        return numbers


_STAND_INS: dict[str, Callable[..., Any]] = {
    "numpy.core.multiarray._reconstruct": lambda *_: PickledArray(),
    "numpy.core.multiarray.scalar": lambda kind, content: kind.numbers(content)[0],
    "numpy.core.numeric._frombuffer": lambda content, kind, shape, order: PickledArray(
        1, shape, kind, order == "F", content
    ),
    "numpy.ndarray": lambda *_: PickledArray(),
    "numpy.dtype": _Kind,
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
