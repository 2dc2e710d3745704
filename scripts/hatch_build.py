"""Builds the native core when the package is installed, editable or not, or a wheel is made.

The core is C++ files that need a compiler and nothing else: that of the system, or where there is
none the one of ``ziglang``, which is then a requirement of the build.
``python scripts/hatch_build.py`` builds the core of a checkout where it lies; with the name of a
file, as WebAssembly with ``ziglang``, which `scripts/wasm` installs. `scripts/wheels` builds it for
the platforms of `WHEELS` with ``ziglang``, and names one in ``SSRVLAD_WHEEL``.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("ssrvlad_torch/native")
SUFFIXES = (".cpp", ".h", ".hpp")
LIBRARY = "libssrvlad" + {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")
FLAGS = ["-std=c++17", "-O3", "-fvisibility=hidden"]
FLAGS += ["-ffp-contract=off"]  # fused sums would differ between processors
SHARED = ["-fPIC", "-shared", "-pthread"]
FOR_BROWSERS = [
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-msimd128", "-fignore-exceptions", "-s"),
    "-Wl,--export-dynamic,--export=malloc,--export=free",
]
ZIG = [sys.executable, "-m", "ziglang", "c++"]
ZIGLANG = "ziglang>=0.17.1"  # 0.15 and 0.16 lack AVX-512 where a function alone asks for it
WITHOUT_RUNTIME = ["-static-libstdc++", "-static-libgcc"]


class Platform(NamedTuple):
    """What a wheel is built for: zig's name of it, the tag of the wheel, and the library's name."""

    target: str
    tag: str
    library: str


WHEELS = {
    "linux_x86_64": Platform(
        "x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64.manylinux2014_x86_64", "libssrvlad.so"
    ),
    "linux_aarch64": Platform(
        "aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64.manylinux2014_aarch64", "libssrvlad.so"
    ),
    "macos_arm64": Platform("aarch64-macos.11.0", "macosx_11_0_arm64", "libssrvlad.dylib"),
    "macos_x86_64": Platform("x86_64-macos.11.0", "macosx_11_0_x86_64", "libssrvlad.dylib"),
    "windows_x86_64": Platform("x86_64-windows-gnu", "win_amd64", "libssrvlad.dll"),
}


class NativeCore(BuildHookInterface):
    """Adds the compiled core to a wheel, which is then one for this platform or the named one."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Called by hatchling for what it installs before a build."""
        return [] if not os.environ.get("SSRVLAD_WHEEL") and compiler() else [ZIGLANG]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it collects the files; a RuntimeError without a core."""
        if name := os.environ.get("SSRVLAD_WHEEL"):
            self._add_for(WHEELS[name], build_data)
            return
        if problem := build(Path(self.root)):
            raise RuntimeError(f"the native core cannot be built: {problem}")
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data.update(pure_python=False, tag=f"py3-none-{tag}")
        build_data["artifacts"].append(str(FOLDER / LIBRARY))

    def _add_for(self, named: Platform, build_data: dict[str, Any]) -> None:
        """Adds the core of another platform."""
        with_zig = [*ZIG, "-target", named.target, "-s", *SHARED]
        self._built = tempfile.TemporaryDirectory()
        library = Path(self._built.name) / named.library
        problem = compile_core(Path(self.root) / FOLDER, with_zig, library)
        if problem:
            raise RuntimeError(problem)
        build_data.update(pure_python=False, tag=f"py3-none-{named.tag}")
        build_data["force_include"][str(library)] = str(FOLDER / named.library)

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Called by hatchling after it wrote the wheel."""
        if hasattr(self, "_built"):
            self._built.cleanup()


def compiler() -> list[str]:
    """The command of this machine's C++ compiler; empty without one that works."""
    if named := shlex.split(os.environ.get("CXX", "")):
        return named
    found = map(shutil.which, ("c++", "g++", "clang++"))
    return next(([path] for path in found if path and _compiles(path)), [])


def _compiles(path: str) -> bool:
    """Whether a compiler has the standard library: that of macOS may only offer to install it."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "try.cpp"
        source.write_text("#include <thread>\n")
        command = [path, *FLAGS, *SHARED, source, "-o", source.with_suffix(".so")]
        return not subprocess.run(command, check=False, capture_output=True).returncode


def _zig_here() -> list[str]:
    """zig for this machine as for its wheel; else for any processor of its kind."""
    system = {"darwin": "macos", "win32": "windows"}.get(sys.platform, sys.platform)
    machine = platform.machine().lower().replace("amd64", "x86_64")
    wheel = WHEELS.get(f"{system}_{machine}")
    return [*ZIG, *(["-target", wheel.target] if wheel else ["-mcpu=baseline"]), "-s"]


def build(root: Path) -> str:
    """Compiles the core into its folder; returns why not, or nothing."""
    folder = root / FOLDER
    fresh = folder / f"{LIBRARY}.{os.getpid()}"
    named = compiler()
    if not named and not importlib.util.find_spec("ziglang"):
        return f"no C++ compiler: install one, or pip install '{ZIGLANG}'"
    commands = [[*named, *more] for more in (WITHOUT_RUNTIME, [])] if named else [_zig_here()]
    for command in commands:
        problem = compile_core(folder, [*command, *SHARED], fresh)
        if not problem:
            fresh.replace(folder / LIBRARY)
            break
    return problem


def compile_core(folder: Path, compiler: Sequence[str], library: Path) -> str:
    """Compiles the sources of a folder to a library; returns why not, or nothing."""
    sources = sorted(file for file in folder.iterdir() if file.suffix in SUFFIXES)
    source = b"".join(file.read_bytes() for file in sources)
    command = [*compiler, *FLAGS, f'-DSSRVLAD_SOURCE="{hashlib.sha256(source).hexdigest()}"']
    compiled = [file for file in sources if file.suffix == ".cpp"]
    # else operators of the C++ library are exported too
    exports = [f"-Wl,--version-script={folder / 'exports.map'}"] if ".so" in library.name else []
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = [Path(scratch) / f"{file.stem}.o" for file in compiled]
        pairs = zip(compiled, objects, strict=True)
        steps = [[*command, "-c", file, "-o", target] for file, target in pairs]
        problems = filter(None, pool.map(_problem_of, steps))
        return next(problems, "") or _problem_of([*command, *objects, "-o", library, *exports])


def _problem_of(command: Sequence[str | Path]) -> str:
    """Why a compiler fails, or nothing."""
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    except OSError as error:
        return f"{command[0]}: {error.strerror}"
    if not done.returncode:
        return ""
    lines = done.stderr.strip().splitlines() or ["?"]
    return f"{command[0]} failed: {next((line for line in lines if 'error' in line), lines[0])}"


def build_for_browsers(root: Path, module: Path) -> str:
    """Compiles the core to a module of WebAssembly; returns why not, or nothing."""
    return compile_core(root / FOLDER, [*ZIG, *FOR_BROWSERS], module)


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description="Compiles the native core in its place.")
    parser.add_argument("module", type=Path, nargs="?", help="WebAssembly for browsers instead")
    MODULE = parser.parse_args().module
    sys.exit((build_for_browsers(ROOT, MODULE) if MODULE else build(ROOT)) or None)
