"""The native core against the stages in torch: the same descriptors, so the same bits."""

import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import ROAD, SPACE, VOID, blobs, every_neighbourhood
from hatchling.builders.wheel import WheelBuilder
from helpers import outcome, refuses
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, native
from ssrvlad_torch.config import CHOICES
from ssrvlad_torch.native.addresses import address
from ssrvlad_torch.native.operator import operator
from ssrvlad_torch.stages.layers import category_table
from ssrvlad_torch.taxonomy import label_space

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import hatch_build  # noqa: E402 - of no package

SIZES = st.integers(1, 140)

pytestmark = pytest.mark.usefixtures("core")


def maps(seed: int, count: int, height: int, width: int, grain: int = 8) -> Tensor:
    """Label maps of ids 0 to 11."""
    drawn = [blobs(seed * count + number, height, width, grain) for number in range(count)]
    return torch.from_numpy(np.stack(drawn))


def arguments_of(labels: Tensor, config: SSRVLADConfig) -> tuple[Tensor, Tensor, int, str]:
    """Those of the operator."""
    return labels, *category_table(label_space(config.labels_as)), json.dumps(config.to_dict())


def describe(labels: Tensor, config: SSRVLADConfig) -> Tensor:
    return operator(*arguments_of(labels, config))


CONFIGS = {
    "default": {},
    "paper": {},
    "default, small": {"working_size": 20, "anchor": "middle", "power": 0.5},
    "paper, key-points": {"context": "keypoints", "opening": 0.02, "sectors": 7, "rings": 3},
    "paper, guo-hall": {"thinning": "guo-hall", "working_size": 40, "hole_area": 0.0},
}
configs = pytest.mark.parametrize(
    "config",
    [
        SSRVLADConfig.from_preset(name.split(",")[0], labels_as=SPACE, **settings)
        for name, settings in CONFIGS.items()
    ],
    ids=CONFIGS,
)


def assert_described(labels: Tensor, config: SSRVLADConfig) -> None:
    """The numbers of the stages, and zeros for an image without layers."""
    expected = SSRVLAD(config).explain(labels).descriptor
    torch.testing.assert_close(describe(labels, config), expected, rtol=0, atol=1e-6)
    assert not describe(torch.full_like(labels, VOID), config).any()


@configs
@given(seed=st.integers(0, 1000), height=st.integers(1, 80), width=st.integers(1, 200))
def test_descriptors_equal_the_torch_stages(config, seed, height, width):
    assert_described(maps(seed, 2, height, width), config)


BARE = {"closing": 0.0, "hole_area": 0.0, "region_area": 0.0}
CLEANED = {"opening": 0.1, "closing": 0.2, "hole_area": 0.05, "region_area": 0.05}


def assert_stages(layer: Tensor, **settings: float) -> None:
    """Thinned in both ways: a pixel of a skeleton more is another descriptor."""
    labels = torch.where(layer, ROAD, VOID)
    for thinning in CHOICES["thinning"]:
        chosen = {**BARE, **settings, "thinning": thinning, "labels_as": SPACE}
        assert_described(labels, SSRVLADConfig.from_preset("paper", **chosen))


def test_every_neighbourhood_is_described_as_by_the_torch_stages():
    layers = every_neighbourhood()[:, None] >> torch.arange(8)[:, None, None] & 1
    assert_stages(layers.flatten(0, 1) > 0)


FRACTION = st.floats(0, 0.5)


@given(
    seed=st.integers(0, 10_000),
    height=SIZES,
    width=SIZES,
    density=st.floats(0.05, 0.95),
    settings=st.fixed_dictionaries(dict.fromkeys(CLEANED, FRACTION)) | st.just(BARE),
)
def test_noise_is_described_as_by_the_torch_stages(seed, height, width, density, settings):
    generator = torch.Generator().manual_seed(seed)
    assert_stages(torch.rand(2, height, width, generator=generator) < density, **settings)


def test_large_regions_are_described_as_by_the_torch_stages():
    """Thinned in many sub-iterations, across tiles and words."""
    noise = torch.rand(1, 260, 330, generator=torch.Generator().manual_seed(3)) < 0.125
    assert_stages(noise, closing=2 / 260, hole_area=1e-4, region_area=5e-3)


def test_many_points_are_counted_by_rows_and_equal_the_torch_stages():
    """With this many points shape contexts are counted by rows, not by pairs."""
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE, **BARE)
    assert_described(maps(8, 1, 150, 260, grain=2), config)


def test_threads_and_batches_change_nothing():
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE)
    labels = maps(6, 7, 60, 90)
    expected = torch.cat([describe(image[None], config) for image in labels])
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert torch.equal(describe(labels, config), expected)
        with ThreadPoolExecutor(4) as pool:
            described = pool.map(lambda _: describe(labels, config), range(8))
            assert all(torch.equal(got, expected) for got in described)
    finally:
        torch.set_num_threads(before)


def test_the_operator_passes_opcheck():
    """Schema, fake kernel and ahead-of-time dispatch."""
    arguments = arguments_of(maps(2, 2, 40, 50), SSRVLADConfig(labels_as=SPACE))
    torch.library.opcheck(operator, arguments)


def test_a_few_seeds_are_in_range(core, tmp_path):
    library = Path(core.library._name)
    flags = ["-std=c++17", "-pthread", f"-I{library.parent}", f"-Wl,-rpath,{library.parent}"]
    sources = [ROOT / "tests" / "fuzz.cpp", library]
    subprocess.run(["g++", *flags, *sources, "-o", tmp_path / "fuzz"], check=True)
    assert outcome(tmp_path / "fuzz", "0", "20") == (0, ["clean"], [])


@pytest.mark.slow
def test_sanitisers_find_nothing(tmp_path):
    folder = ROOT / "ssrvlad_torch" / "native"
    flags = ["-std=c++17", "-O0", "-ffp-contract=off", "-pthread", f"-I{folder}"]
    flags += ["-Wall", "-Wextra", "-Werror"]
    checks = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
    sources = [ROOT / "tests" / "fuzz.cpp", *folder.glob("*.cpp")]
    subprocess.run(["g++", *flags, *checks, *sources, "-o", tmp_path / "fuzz"], check=True)
    assert outcome(tmp_path / "fuzz", "20", "300") == (0, ["clean"], [])


def test_fast_math_is_refused_as_it_is_compiled():
    header = ROOT / "ssrvlad_torch" / "native" / "cpu.hpp"
    command = ("g++", "-std=c++17", "-fsyntax-only", "-x", "c++", header)
    assert outcome(*command)[0] == 0
    code, _, errors = outcome(*command, "-ffast-math")
    assert code == 1 and "compile without -ffast-math" in "".join(errors)


def test_a_library_of_another_source_is_refused(tmp_path, monkeypatch):
    for file in native.FOLDER.glob("*.*"):
        shutil.copy(file, tmp_path)
    with (tmp_path / "ssrvlad.cpp").open("a") as source:
        source.write("// changed\n")
    monkeypatch.setattr(native, "FOLDER", tmp_path)
    got = native.core.__wrapped__()
    assert got.library is None and "another version" in got.status


def test_a_missing_compiler_is_named(tmp_path, monkeypatch):
    shutil.copytree(native.FOLDER, tmp_path / hatch_build.FOLDER)
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert hatch_build.build(tmp_path) == "no-such-compiler: No such file or directory"


def test_without_a_compiler_the_build_requires_one_from_pypi(monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    assert WheelBuilder(str(ROOT)).config.dependencies == []
    monkeypatch.setenv("PATH", "")
    assert WheelBuilder(str(ROOT)).config.dependencies == [hatch_build.ZIGLANG]


# ---- where an array is in memory: only what the core takes has an address


@pytest.mark.parametrize("make", [np.zeros, torch.zeros])
def test_the_address_is_that_of_the_first_number(make):
    rows = make((4, 3), dtype=np.float32 if make is np.zeros else torch.float32)
    first = rows.ctypes.data if make is np.zeros else rows.data_ptr()
    assert address(rows, (4, 3), "float32") == first
    assert address(rows[2:], [2, 3], "uint8", "float32") == first + 2 * 3 * 4


@pytest.mark.parametrize(
    ("array", "got"),
    [
        (torch.zeros(4, 3, dtype=torch.float64), r"\(4, 3\) of float64 on cpu"),
        (torch.zeros(4, 3, dtype=torch.bfloat16), r"\(4, 3\) of bfloat16 on cpu"),
        (torch.zeros(4, 3, device="meta"), r"\(4, 3\) of float32 on meta"),
        (torch.zeros(3, 4).T, r"\(4, 3\) of float32 on cpu, not contiguous"),
        (torch.zeros(3, 4), r"\(3, 4\) of float32 on cpu"),
        (np.zeros((4, 3)), r"\(4, 3\) of float64 on cpu"),
        (np.zeros((4, 3), ">f4"), r"\(4, 3\) of >f4 on cpu"),
        (np.zeros((4, 6), np.float32)[:, ::2], r"\(4, 3\) of float32 on cpu, not contiguous"),
    ],
)
def test_an_array_that_the_core_does_not_take_is_refused(array, got):
    message = rf"expected an array \(4, 3\) of float32 on cpu, got {got}"
    refuses(message, address, array, (4, 3), "float32")
