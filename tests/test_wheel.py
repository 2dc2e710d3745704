"""What a user installs: the built wheel, away from the repository."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


COPIER = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[-1])"
"""Stands for a compiler that has compiled the core before."""


@pytest.fixture(scope="module")
def wheel(core, tmp_path_factory):
    out = tmp_path_factory.mktemp("dist")
    compiler = shlex.join([sys.executable, "-c", COPIER, core.library._name])
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "CXX": compiler})
    return next(out.glob("*.whl"))


def test_it_holds_all_that_the_package_needs(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = {
        str(file.relative_to(ROOT))
        for pattern in ("*.py", "*.yaml", "py.typed")
        for file in (ROOT / "ssrvlad_torch").rglob(pattern)
    }
    assert {*sources, "ssrvlad_torch/native/libssrvlad.so"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests", "scripts"))]


def test_it_runs_the_demo_away_from_the_repository(wheel, tmp_path):
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    done = subprocess.run(
        [sys.executable, "-m", "ssrvlad_torch", "demo", "--frames", "8"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "RecallRate@1" in done.stdout
    assert (tmp_path / "ssrvlad-demo" / "demo.png").exists()
