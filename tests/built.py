"""Programs that take long to build, once for all tests of a run: those in C++, as export/README.md
says, and the web page with its core. Without a tool that they need, their tests are skipped."""

import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from browser import CHROMIUM, browser, served
from exported import of_preset
from filelock import FileLock
from helpers import outcome

from ssrvlad_torch import export_head

ROOT = Path(__file__).parents[1]
Fixtures = Callable[[str], Any]
"""The value of a fixture by its name."""
WEB = ROOT / "export" / "web"
STRICT = {
    **os.environ,
    "CXXFLAGS": "-Wall -Wextra -Werror",
    "CMAKE_BUILD_TYPE": "Debug",
    "CMAKE_BUILD_PARALLEL_LEVEL": "2",
}


def must(*command, **options):
    """The lines of a command that succeeds, warnings being errors."""
    code, out, errors = outcome(*command, env=STRICT, **options)
    assert code == 0, "\n".join([*out, *errors])
    return out


def commands(*programs):
    """Those of export/README.md that begin with such words."""
    page = (ROOT / "export" / "README.md").read_text("utf-8")
    typed = [line[2:] for line in page.splitlines() if line.startswith("$ ")]
    return [command for command in typed if command.startswith(programs)]


def built_once(tmp_path_factory, name, build):
    """The folder that ``build(folder)`` fills, shared by all workers of a run."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    done = folder / ".built"
    with FileLock(f"{folder}.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            build(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def user(tmp_path_factory):
    """The folder export/ of a user who typed the page's commands of CMake: ``build`` has the
    programs, ``build-describe`` the one over the core alone. It needs zlib and ONNX Runtime: in the
    folder that ORT_ROOT names, or as a CMake package."""
    if not shutil.which("cmake"):
        pytest.skip("CMake is not installed")
    return built_once(tmp_path_factory, "checkout", _build_programs) / "export"


def _build_programs(checkout):
    (checkout / "ssrvlad_torch").symlink_to(ROOT / "ssrvlad_torch")
    folder = checkout / "export"
    folder.mkdir()
    for file in (ROOT / "export").iterdir():
        (folder / file.name).symlink_to(file)
    code, _, errors = outcome("cmake", "-S", "cpp", "-B", "try", cwd=folder)
    if code:
        assert "ORT_ROOT" not in os.environ, errors
        assert any(name in line for name in ("onnxruntime", "ZLIB") for line in errors), errors
        pytest.skip(
            "the C++ headers of ONNX Runtime or zlib are not installed; ORT_ROOT names their folder"
        )
    for command in commands("cmake"):
        for part in command.replace(" -DORT_ROOT=/opt/onnxruntime", "").split(" && "):
            must(*part.split(), cwd=folder)


def _runtime():
    """A ``node_modules`` with what the lock file says, kept for the next run."""
    if (WEB / "node_modules").is_dir():
        return WEB / "node_modules"
    lock = (WEB / "package-lock.json").read_bytes()
    stored = ROOT / ".cache" / f"web-{hashlib.sha256(lock).hexdigest()[:16]}"
    if not stored.is_dir():
        if not shutil.which("npm"):
            pytest.skip("npm is not installed")
        stored.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=stored.parent) as folder:
            for name in ("package.json", "package-lock.json"):
                shutil.copy(WEB / name, folder)
            command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
            if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
                pytest.skip("npm cannot install onnxruntime-web here")
            with contextlib.suppress(OSError):  # another process was faster
                (Path(folder) / "node_modules").rename(stored)
    return stored


def _build_site(folder):
    build = [sys.executable, ROOT / "scripts" / "hatch_build.py", folder / "ssrvlad.wasm"]
    subprocess.run(build, check=True)
    for preset in ("default", "paper"):
        export_head(of_preset(preset), folder / f"{preset}.onnx")


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """A folder with the page, its core, and a head of each preset."""
    if not CHROMIUM:
        pytest.skip("Chromium is not installed")
    pytest.importorskip("ziglang")
    built = built_once(tmp_path_factory, "site", _build_site)
    folder = tmp_path_factory.mktemp("site") / "web"
    shutil.copytree(WEB, folder, ignore=shutil.ignore_patterns("node_modules"))
    shutil.copytree(built, folder, dirs_exist_ok=True)
    (folder / "node_modules").symlink_to(_runtime())
    return folder


@pytest.fixture(scope="session")
def page(site, tmp_path_factory):
    """A tab, and the address that the page has in it."""
    with browser(tmp_path_factory.mktemp("profile")) as tab, served(site) as address:
        tab.address = f"{address}/index.html"
        yield tab
