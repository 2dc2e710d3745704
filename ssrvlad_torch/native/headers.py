"""The headers of the core as ctypes: their structs, the types of their functions, their numbers.

The package reads its own headers so that types cannot drift; the grammar is what these files use.
"""

import ctypes
import re
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).parent
_FILES = "ssrvlad.h", "ssrvlad_map.h", "ssrvlad_loops.h"
_TYPES: dict[str, Any] = {
    **{"void": None, "int": ctypes.c_int, "double": ctypes.c_double},
    **{"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64},
}
_SKIPPED = re.compile(
    r"/\*.*?\*/|^#.*?$|\b(?:SSRVLAD_API|const|struct)\b", re.DOTALL | re.MULTILINE
)
_STRUCT, _NUMBER = (
    re.compile(r"typedef +\w+ \{(.*?)\} (\w+);", re.DOTALL),
    r"(SSRVLAD_\w+) (?:= )?(-?\d+)",
)
_FUNCTION = re.compile(r"^ *(\w+ *\**)\s*(ssrvlad_\w+)\((.*?)\);", re.DOTALL | re.MULTILINE)


class Interface(NamedTuple):
    """What the headers declare, by names: structs; of functions the types of the result and of the
    arguments; numbers. A pointer to a struct takes one, other pointers take addresses."""

    structs: dict[str, Any]
    functions: dict[str, tuple[Any, list[Any]]]
    numbers: dict[str, int]


@cache
def interface() -> Interface:
    """The interface, read once."""
    content = "\n".join((FOLDER / name).read_text("utf-8") for name in _FILES)
    numbers = {name: int(number) for name, number in re.findall(_NUMBER, content)}
    text = _SKIPPED.sub("", content)
    structs = dict[str, Any]()

    def type_of(declaration: str) -> Any:
        name = declaration.split(maxsplit=1)[0].rstrip("*")
        if "*" in declaration:
            return ctypes.POINTER(structs[name]) if name in structs else ctypes.c_void_p
        return structs.get(name) or _TYPES[name]

    def arguments(declaration: str) -> list[Any]:
        return [type_of(argument) for argument in declaration.split(",") if argument != "void"]

    def fields(line: str) -> list[tuple[str, Any]]:
        members, (base, names) = [], line.split(maxsplit=1)
        for declarator in names.split(","):
            name, _, size = declarator.strip(" ]").partition("[")
            member = ctypes.c_void_p if "*" in name else type_of(base)
            if size:
                member *= numbers[size] if size in numbers else int(size)
            members.append((name.lstrip("*"), member))
        return members

    for body, name in _STRUCT.findall(text):
        lines = (" ".join(line.split()) for line in body.split(";") if line.strip())
        members = {"_fields_": [field for line in lines for field in fields(line)]}
        structs[name] = type(name, (ctypes.Structure,), members)
    functions = {
        name: (ctypes.c_void_p if "*" in result else type_of(result), arguments(declaration))
        for result, name, declaration in _FUNCTION.findall(text)
    }
    return Interface(structs, functions, numbers)


@cache
def model(name: str) -> dict[str, float]:
    """The numbers of a struct of ``model.hpp``, which explains them: ``Place`` or ``Loop``."""
    content = (FOLDER / "model.hpp").read_text("utf-8")
    body = content.partition(f"struct {name}Model {{")[2].partition("};")[0]
    return {key: float(value) for key, value in re.findall(r"(\w+) = ([\d.e-]+)F?[,;]", body)}


def struct(name: str) -> Any:
    """The struct ``ssrvlad_NAME``."""
    return interface().structs[f"ssrvlad_{name}"]


def number(name: str) -> int:
    """The number ``SSRVLAD_NAME``."""
    return interface().numbers[f"SSRVLAD_{name}"]


def typed(library: ctypes.CDLL) -> ctypes.CDLL:
    """A library, with the types of its functions."""
    for name, (result, arguments) in interface().functions.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
