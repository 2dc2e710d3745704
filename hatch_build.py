"""Builds the native core when the package is installed, editable or not, or a wheel is made.

The core is one C++ file that needs a compiler and nothing else. Without one the package is built
as well: it then describes label maps by torch, more slowly, with the same numbers.
``python hatch_build.py`` builds the core of a checkout where it lies.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("ssrvlad_torch/native")
SOURCES = ("ssrvlad.cpp", "ssrvlad.h")
LIBRARY = "libssrvlad.so"
FLAGS = ["-std=c++17", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-pthread"]
WITHOUT_RUNTIME = ["-static-libstdc++", "-static-libgcc"]


class NativeCore(BuildHookInterface):
    """Adds the compiled core to a wheel, which is then one for this platform."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it collects the files."""
        problem = build(Path(self.root))
        if problem:
            self.app.display_warning(f"native core not built: {problem}; torch does its work")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data.update(pure_python=False, tag=f"py3-none-{platform}")
        build_data["artifacts"].append(str(FOLDER / LIBRARY))


def build(root: Path) -> str:
    """Compiles the core into its folder; returns why not, or nothing."""
    folder = root / FOLDER
    library, fresh = folder / LIBRARY, folder / f"{LIBRARY}.{os.getpid()}"
    if os.name == "nt":
        return "not on Windows"
    named = shlex.split(os.environ.get("CXX", ""))
    found = [[path] for path in map(shutil.which, ("c++", "g++", "clang++")) if path]
    compilers = [named] if named else found
    if not compilers:
        return "no C++ compiler"
    source = b"".join((folder / name).read_bytes() for name in SOURCES)
    digest = f'-DSSRVLAD_SOURCE="{hashlib.sha256(source).hexdigest()}"'
    for runtime in (WITHOUT_RUNTIME, []):
        command = [*compilers[0], *FLAGS, *runtime, digest, folder / SOURCES[0], "-o", fresh]
        try:
            done = subprocess.run(command, check=False, capture_output=True, text=True)
        except OSError as error:
            return f"{compilers[0][0]}: {error.strerror}"
        if done.returncode == 0:
            fresh.replace(library)
            return ""
    return f"{compilers[0][0]} failed: {(done.stderr.strip().splitlines() or ['?'])[0]}"


if __name__ == "__main__":
    sys.exit(build(Path(__file__).parent) or None)
