"""What a user installs: wheels, built from the source archive, away from the repository."""

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from helpers import outcome

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

from _wheels import FOLDER, WHEELS, problems_of, wheels  # noqa: E402

COMPILER = """#!/bin/sh
while [ "$1" != -o ]; do shift; done
cp "{library}" "$2"
"""


@pytest.fixture(scope="module")
def wheel(core, tmp_path_factory):
    """The wheel that pip makes of the source archive on this machine. Its compiler copies the core
    that the same hook compiled here: a core of other sources than the wheel has is refused."""
    out = tmp_path_factory.mktemp("dist")
    compiler = tmp_path_factory.mktemp("bin") / "c++"
    compiler.write_text(COMPILER.format(library=core.library._name))
    compiler.chmod(0o755)
    command = (sys.executable, "-m", "build", "--no-isolation", "--outdir", out, ROOT)
    env = environment_without("SSRVLAD_WHEEL") | {"CXX": str(compiler)}
    code, _, errors = outcome(*command, env=env)
    assert code == 0, errors
    assert len(list(out.glob("*.tar.gz"))) == 1
    [wheel] = out.glob("*.whl")
    return wheel


def environment_without(*names):
    return {name: value for name, value in os.environ.items() if name not in names}


def test_the_wheel_holds_all_that_the_package_needs(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    sources = {
        str(file.relative_to(ROOT))
        for pattern in ("*.py", "*.yaml", "py.typed")
        for file in (ROOT / "ssrvlad_torch").rglob(pattern)
    }
    assert {*sources, "ssrvlad_torch/native/libssrvlad.so"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests", "scripts"))]


DESCRIBE = """
import shutil, sys, torch
from ssrvlad_torch import SSRVLAD, native
from ssrvlad_torch.cli.main import main
head = SSRVLAD.from_preset("paper", labels_as="camvid-11")
labels = torch.arange(12, dtype=torch.uint8).repeat_interleave(400).view(1, 60, 80)
same = torch.allclose(head(labels), head.explain(labels).descriptor, rtol=0, atol=1e-6)
print(native.FOLDER.parents[1], native.core().status, same, [*map(shutil.which, ("c++", "cc"))])
sys.argv[1:] = ["demo", "--frames", "8"]
main()
"""


def test_the_wheel_runs_in_an_empty_environment_without_a_compiler(wheel, tmp_path):
    """The environment is new, but for a link to the dependencies, which are those of the tests."""
    venv.create(tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps"]
    subprocess.run([*pip, "--no-index", wheel], check=True)
    [site] = (tmp_path / "venv").glob("lib/*/site-packages")
    (site / "dependencies.pth").write_text("\n".join(p for p in sys.path if "site-packages" in p))
    empty = {"PATH": str(tmp_path / "venv" / "bin"), "HOME": str(tmp_path)}
    code, out, errors = outcome(python, "-c", DESCRIBE, cwd=tmp_path, env=empty)
    assert code == 0, errors
    assert re.fullmatch(rf"{site} the native core \((AVX|SSE|NEON).*\) True \[None, None\]", out[0])
    assert "RecallRate@1" in "".join(out)
    assert (tmp_path / "ssrvlad-demo" / "demo.png").exists()


def test_a_library_that_would_not_run_everywhere_is_refused(core):
    """This machine's own compiler made it: with symbols of its glibc, for its processor."""
    import lief

    own = lief.parse(core.library._name)
    assert next(iter(problems_of(own, "linux", "aarch64"))) == "is for X86_64"
    assert any("needs GLIBC_2." in problem for problem in problems_of(own, "linux", "x86_64"))


@pytest.mark.slow
@pytest.mark.parametrize("name", WHEELS)
def test_every_wheel_has_its_tag_and_library(name, tmp_path):
    pytest.importorskip("ziglang")
    (_, source), (built, content) = wheels([name], tmp_path)
    held = [
        Path(n).name for n in zipfile.ZipFile(built).namelist() if n.startswith(f"{FOLDER}/lib")
    ]
    assert source == "source"
    assert held == [WHEELS[name].library] and "native core of" in content
    assert built.name.endswith(f"-py3-none-{WHEELS[name].tag}.whl")


@pytest.mark.slow
def test_the_wheel_installs_with_its_dependencies_alone(wheel, tmp_path):
    """Installed with its dependencies and nothing else into a new environment: minutes."""
    venv.create(tmp_path / "venv", with_pip=True)
    programs = tmp_path / "venv" / "bin"
    constraints = ["--constraint", ROOT / "constraints.txt"]
    install = [programs / "python", "-m", "pip", "install", "--quiet", *constraints, wheel]
    subprocess.run(install, check=True)
    for arguments, expected in (
        (["--version"], wheel.name.split("-")[1]),
        (["demo", "--frames", "8"], "RecallRate@1"),
    ):
        command = (programs / "ssrvlad", *arguments)
        code, out, _ = outcome(*command, cwd=tmp_path, env=environment_without("PYTHONPATH"))
        assert code == 0 and expected in "".join(out)
