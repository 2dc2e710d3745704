"""What a user installs: the wheel, built from the source distribution, away from the repository."""

import os
import shlex
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


COPIER = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[-1])"
"""Stands for a compiler that has compiled the core before."""


@pytest.fixture(scope="module")
def dist(core, tmp_path_factory):
    """What `python -m build` writes."""
    out = tmp_path_factory.mktemp("dist")
    compiler = shlex.join([sys.executable, "-c", COPIER, core.library._name])
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", out, ROOT]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "CXX": compiler})
    return out


@pytest.fixture(scope="module")
def wheel(dist):
    return next(dist.glob("*.whl"))


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


def version_of(folder):
    command = [sys.executable, "-m", "hatchling", "version"]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_the_tag_is_the_version(tmp_path):
    """Without one the version is that of development, and without git none."""
    tree = tmp_path / "tree"
    for name in ("pyproject.toml", "README.md", "ssrvlad_torch/__init__.py"):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tree / name)
    assert version_of(tree) == "0.0"
    for command in ("init -q", "add .", "commit -qm first"):
        git(tree, command)
    assert version_of(tree).startswith("0.1.dev1+g")
    git(tree, "tag v1.2.3")
    assert version_of(tree) == "1.2.3"


def git(folder, command):
    who = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
    subprocess.run(["git", *who, *command.split()], cwd=folder, check=True, capture_output=True)


@pytest.mark.slow
def test_on_an_empty_machine(wheel, tmp_path):
    """Installed with its dependencies and nothing else into a new environment: minutes."""
    venv.create(tmp_path / "venv", with_pip=True)
    programs = tmp_path / "venv" / "bin"
    constraints = ["--constraint", ROOT / "constraints.txt"]
    install = [programs / "python", "-m", "pip", "install", "--quiet", *constraints, wheel]
    subprocess.run(install, check=True)
    inside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for arguments, expected in (
        (["--version"], wheel.name.split("-")[1]),
        (["demo", "--frames", "8"], "RecallRate@1"),
    ):
        done = subprocess.run(
            [programs / "ssrvlad", *arguments],
            cwd=tmp_path,
            env=inside,
            capture_output=True,
            text=True,
            check=True,
        )
        assert expected in done.stdout
