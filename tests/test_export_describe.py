"""The C++ program over the core alone gives the same bits on other processors, emulated, and on
Windows (Wine); and what it refuses."""

import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from subprocess import DEVNULL

import numpy as np
import pytest
from cases import camvid_labels
from conformance.descriptors import cases
from exported import write_categories
from helpers import assert_each_is_one_line, outcome, street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.deployment.golden import golden_pair

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "export" / "cpp" / "describe"
CORE = ROOT / "ssrvlad_torch" / "native"
SPACE = "camvid-11"
ZIG = f"{sys.executable} -m ziglang c++ -s -fPIC -fvisibility=hidden"
OTHERS = {
    "aarch64": ("aarch64-linux-gnu-g++ -static -O1", "qemu-aarch64", ""),
    "32-bit ARM": ("arm-linux-gnueabihf-g++ -static -Wno-psabi -O3", "qemu-arm", ""),
    "aarch64 as in the wheel": (
        f"{ZIG} -O3 -target aarch64-linux-gnu.2.17",
        "qemu-aarch64 -L /usr/aarch64-linux-gnu",
        "",
    ),
    "Windows as in the wheel": (
        f"{ZIG} -O3 -target x86_64-windows-gnu",
        f"env WINEPREFIX={ROOT}/.cache/wine /usr/lib/wine/wine64",
        ".exe",
    ),
}
"""Compiler, what runs its programs, and their suffix."""


@pytest.fixture(scope="module")
def describe(user):
    """The program."""
    return partial(outcome, user / "build-describe" / "describe")


def headers(folder):
    """The option of a compiler for a folder with the headers of the package."""
    (folder / "ssrvlad").symlink_to(CORE)
    return f"-I{folder}"


@pytest.fixture(scope="module", params=OTHERS)
def other(request, tmp_path_factory):
    """The program and the library, compiled for another platform."""
    compiler, runner, suffix = OTHERS[request.param]
    for program in (compiler.split()[0], runner.split()[-1 if "wine" in runner else 0]):
        if not shutil.which(program):
            pytest.skip(f"{program} is not installed")
    if suffix:
        stay_up(request, runner.split())
    program = tmp_path_factory.mktemp("build") / f"describe{suffix}"
    sources = [SOURCE / "describe.cpp", *CORE.glob("*.cpp")]
    flags = ["-std=c++17", "-ffp-contract=off", "-pthread", headers(program.parent)]
    subprocess.run([*compiler.split(), *flags, *sources, "-o", program], check=True)
    return partial(outcome, *runner.split(), program)


def stay_up(request, wine):
    """Starts Windows, which takes seconds, until the tests of the module are done. Nothing may read
    the output of the program that starts it: the services of Windows never close it."""
    server = [*wine[:-1], wine[-1].replace("wine64", "wineserver64")]
    (ROOT / ".cache" / "wine").mkdir(parents=True, exist_ok=True)
    subprocess.run([*server, "-p"], check=True)
    request.addfinalizer(lambda: subprocess.run([*server, "-k"], check=False))
    subprocess.run([*wine, "wineboot"], check=True, stdout=DEVNULL, stderr=DEVNULL)


@pytest.fixture
def inputs(tmp_path):
    """The categories of CamVid's ids, and a label map."""
    np.save(tmp_path / "map.npy", street(0))
    return write_categories(tmp_path / "categories.npy", SPACE), tmp_path / "map.npy"


def assert_the_same_bits(describe, other, preset, space, maps, folder):
    """Nine digits tell all numbers of float32 apart."""
    categories = write_categories(folder / "categories.npy", space)
    for labels in maps:
        np.save(folder / "map.npy", labels)
        here, there = (f(preset, categories, folder / "map.npy") for f in (describe, other))
        assert here[0] == 0 and here[:2] == there[:2], there[2]  # Wine fills stderr


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_other_platforms(describe, other, preset, tmp_path):
    first, *_ = golden_pair(SSRVLAD.from_preset(preset, labels_as=SPACE), "labels", "uint8")[
        "labels"
    ]
    maps = [*cases().values(), first, *camvid_labels(300)]
    assert_the_same_bits(describe, other, preset, SPACE, maps, tmp_path)


def test_wrong_use_is_one_line(describe, inputs, tmp_path):
    categories, labels = inputs
    np.save(tmp_path / "strange.npy", np.full((4, 5), 77, np.uint8))
    np.save(tmp_path / "real.npy", np.zeros((4, 5)))
    table = [
        (("default", categories), "usage"),
        (("best", categories, labels), "expected the preset default or paper, got best"),
        (("default", labels, labels), "expected (256,) uint8, got 2 axes"),
        (("default", categories, tmp_path / "none.npy"), "cannot be read"),
        (("default", categories, tmp_path / "strange.npy"), "20 pixels have an id without"),
        (("default", categories, tmp_path / "real.npy"), "got 2 axes of <f8"),
    ]
    assert_each_is_one_line(describe, table)
