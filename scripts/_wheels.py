"""Builds a source archive, and from it a wheel for each platform; checks what they hold."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hatch_build import FOLDER, WHEELS

ROOT = Path(__file__).resolve().parents[1]

OF_THE_SYSTEM = {
    "linux": r"lib(c|m|pthread|dl)\.so\.\d|ld-linux-(x86-64|aarch64)\.so\.\d",
    "macos": r"/usr/lib/libSystem\.B\.dylib|@rpath/.*|.*libssrvlad\.dylib",
    "windows": r"(KERNEL32|ntdll|api-ms-win-crt-[\w-]+)\.dll",
}
"""The libraries that a native core may need, and on macOS its own name."""

PROCESSOR = {"x86_64": "X86_64|AMD64", "aarch64": "AARCH64", "arm64": "ARM64"}
NEWEST_GLIBC = 2, 17


def wheels(names: Sequence[str], out: Path) -> Iterator[tuple[Path, str]]:
    """Builds the source archive and the wheels of some platforms; each file with what it holds.

    Args:
        names: of `hatch_build.WHEELS`.
        out: folder to write to; made if it does not exist.

    Raises:
        ValueError: a wheel cannot be built, or does not run on all machines that its tag names.
    """
    out.mkdir(parents=True, exist_ok=True)
    source = _build("--sdist", ROOT, out)
    yield source, "source"
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(source) as archive:
            archive.extractall(folder, filter="data")
        [tree] = Path(folder).iterdir()
        for name in names:
            wheel = _build("--wheel", tree, out, name)
            yield wheel, _checked(wheel, name)


def _build(kind: str, tree: Path, out: Path, name: str = "") -> Path:
    command = [sys.executable, "-m", "build", kind, "--no-isolation", "--outdir", out, tree]
    environment = {**os.environ, "SSRVLAD_WHEEL": name}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise ValueError(f"{name or kind} cannot be built:\n{done.stdout}{done.stderr}")
    *_, built = re.findall(r"Successfully built (\S+)", done.stdout)
    return out / built


def _checked(wheel: Path, name: str) -> str:
    """The native core of a wheel in words, after its checks."""
    import lief

    with zipfile.ZipFile(wheel) as archive:
        libraries = [
            file for file in archive.namelist() if Path(file).name.startswith("libssrvlad")
        ]
        expected = [str(FOLDER / WHEELS[name].library)]
        if libraries != expected:
            raise ValueError(f"{wheel.name}: expected {expected}, got {libraries}")
        content = archive.read(libraries[0])
    lief.logging.disable()  # it reports what other systems lack
    library = lief.parse(content)
    if problem := next(problems_of(library, *name.split("_", 1)), None):
        raise ValueError(f"{wheel.name}: {libraries[0]} {problem}")
    if name.startswith("linux"):
        _audit(wheel)
    return f"native core of {len(content) // 1024} kB"


def problems_of(library: Any, system: str, processor: str) -> Iterator[str]:
    """Why a library does not run on every machine of a system and processor; nothing if it does."""
    header = library.header
    machine = {"macos": "cpu_type", "linux": "machine_type", "windows": "machine"}[system]
    if not re.fullmatch(PROCESSOR[processor], getattr(header, machine).name):
        yield f"is for {getattr(header, machine).name}"
    headers = "".join(file.read_text() for file in (ROOT / FOLDER).glob("*.h"))
    code = re.sub(r"/\*.*?\*/|^#.*?$", "", headers, flags=re.DOTALL | re.MULTILINE)
    declared = set(re.findall(r"\w+(?=\()", code))
    declared = {name for name in declared if name.startswith("ssrvlad_")}
    exported = {_name(one).removeprefix("_") for one in library.exported_functions}
    if missing := declared - exported:
        yield f"does not export {', '.join(sorted(missing))}"
    # on macOS also operators of the C++ library, and two symbols that the linker adds
    if system != "macos" and (more := exported - declared):
        yield f"exports {', '.join(sorted(more))}"
    for needed in map(_name, library.libraries):
        if not re.fullmatch(OF_THE_SYSTEM[system], needed):
            yield f"needs {needed}"
    if system == "linux":
        versions = [
            symbol.name
            for one in library.symbols_version_requirement
            for symbol in one.get_auxiliary_symbols()
        ]
        for version in versions:
            if tuple(map(int, version.removeprefix("GLIBC_").split("."))) > NEWEST_GLIBC:
                yield f"needs {version}"


def _name(entry: Any) -> str:
    return entry if isinstance(entry, str) else str(entry.name)


def _audit(wheel: Path) -> None:
    """auditwheel's opinion of a wheel for Linux; a ValueError if that is not its tag."""
    command = [sys.executable, "-m", "auditwheel", "show", wheel]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    tag = re.search(r"platform tag:\s+\"(\w+)\"", done.stdout)
    if not tag or not re.match(r"manylinux_2_(\d|1[0-7])_", tag[1]):
        raise ValueError(f"{wheel.name}: auditwheel says {done.stdout}{done.stderr}")


if __name__ == "__main__":
    if strange := set(sys.argv[1:]) - {*WHEELS}:
        sys.exit(f"wheels: expected {', '.join(WHEELS)}, got {min(strange)}")
    try:
        for built, content in wheels(sys.argv[1:] or [*WHEELS], ROOT / "dist"):
            print(f"{built.relative_to(ROOT)}: {content}", flush=True)
    except ValueError as error:
        sys.exit(f"wheels: {error}")
