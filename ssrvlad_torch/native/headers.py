"""The headers of the core as ctypes: their structs, and the types of their functions."""

import ctypes
import re
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

FOLDER = Path(__file__).parent
_FILES = "ssrvlad.h", "ssrvlad_decide.h", "ssrvlad_map.h", "ssrvlad_loops.h"
_KINDS: dict[str, Any] = {
    **{"void": None, "int": ctypes.c_int, "double": ctypes.c_double},
    **{"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64},
}
_UNREAD = re.compile(r"/\*.*?\*/|^#.*?$|\b(?:SSRVLAD_API|const|struct)\b", re.DOTALL | re.MULTILINE)
_STRUCT, _NUMBER = re.compile(r"typedef +\w+ \{(.*?)\} (\w+);", re.DOTALL), r"(SSRVLAD_\w+) = (\d+)"
_FUNCTION = re.compile(r"^ *(\w+ *\**)\s*(ssrvlad_\w+)\((.*?)\);", re.DOTALL | re.MULTILINE)


class Interface(NamedTuple):
    """What the headers declare, by names: structs, and of functions the types of the result and of
    the arguments. A pointer to a struct takes one, other pointers take addresses."""

    structs: dict[str, Any]
    functions: dict[str, tuple[Any, list[Any]]]


@cache
def interface() -> Interface:
    """The interface, read once."""
    text = _UNREAD.sub("", "\n".join((FOLDER / name).read_text("utf-8") for name in _FILES))
    numbers, structs = dict(re.findall(_NUMBER, text)), dict[str, Any]()

    def kind(declared: str) -> Any:
        name = declared.split(maxsplit=1)[0].rstrip("*")
        if "*" in declared:
            return ctypes.POINTER(structs[name]) if name in structs else ctypes.c_void_p
        return structs.get(name) or _KINDS[name]

    def arguments(declared: str) -> list[Any]:
        return [kind(each) for each in declared.split(",") if each != "void"]

    def fields(line: str) -> list[tuple[str, Any]]:
        if called := re.match(r"(\w+) \(\*(\w+)\)\((.*)\)", line):
            return [(called[2], ctypes.CFUNCTYPE(_KINDS[called[1]], *arguments(called[3])))]
        found, (base, names) = [], line.split(maxsplit=1)
        for each in names.split(","):
            name, _, size = each.strip(" ]").partition("[")
            own = ctypes.c_void_p if "*" in name else kind(base)
            if size:
                own *= int(numbers.get(size, size))
            found.append((name.lstrip("*"), own))
        return found

    for body, name in _STRUCT.findall(text):
        lines = (" ".join(line.split()) for line in body.split(";") if line.strip())
        members = {"_fields_": [each for line in lines for each in fields(line)]}
        structs[name] = type(name, (ctypes.Structure,), members)
    return Interface(structs, {
        name: (ctypes.c_void_p if "*" in result else kind(result), arguments(given))
        for result, name, given in _FUNCTION.findall(text)
    })  # fmt: skip


def struct(name: str) -> Any:
    """The struct ``ssrvlad_NAME``."""
    return interface().structs[f"ssrvlad_{name}"]


def typed(library: ctypes.CDLL) -> ctypes.CDLL:
    """A library, with the types of its functions."""
    for name, (result, given) in interface().functions.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, given
    return library
