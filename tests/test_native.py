"""The native core against the stages in torch: the same bits and counts."""

import ctypes
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from drawings import MASKS, SPACE, VOID, blobs, every_neighbourhood, mask, planes
from hatchling.builders.wheel import WheelBuilder
from helpers import outcome
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, native
from ssrvlad_torch.config import CHOICES, PRESETS
from ssrvlad_torch.native.headers import number, struct
from ssrvlad_torch.native.operator import operator
from ssrvlad_torch.stages.components import drop_regions, fill_holes
from ssrvlad_torch.stages.keypoints import end_points, intersections
from ssrvlad_torch.stages.layers import categorise, category_table
from ssrvlad_torch.stages.morphology import open_and_close
from ssrvlad_torch.stages.reduction import reduce_by_majority
from ssrvlad_torch.stages.skeleton import RULES, thin
from ssrvlad_torch.taxonomy import label_space

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import hatch_build  # noqa: E402 - of no package

SIZES = st.integers(1, 140)

pytestmark = pytest.mark.usefixtures("core")


def run(stage: str, some: Tensor, *arguments: int, results: int = 1) -> tuple[Tensor, ...]:
    """A stage of the core on ``(B, H, W)`` bit-planes."""
    targets = tuple(torch.empty_like(some) for _ in range(results))
    function = getattr(native.core().library, f"ssrvlad_{stage}")
    pointers = [target.data_ptr() for target in targets]
    assert function(some.data_ptr(), *some.shape, *arguments, *pointers) == 0
    return targets


def assert_the_same(some: Tensor, radius: int = 1, area: int = 5) -> None:
    """Every stage, on the same planes."""
    for opening, closing in ((radius, 0), (0, radius), (radius, radius + 1)):
        got = run("open_and_close", some, opening, closing)[0]
        assert torch.equal(got, open_and_close(some, opening, closing))
    assert torch.equal(run("fill_holes", some, area)[0], fill_holes(some, area))
    assert torch.equal(run("drop_regions", some, area)[0], drop_regions(some, area))
    for rule, name in enumerate(CHOICES["thinning"]):
        assert torch.equal(run("thin", some, rule)[0], thin(some, RULES[name]))
    ends, crossings = run("keypoints", some, results=2)
    assert torch.equal(ends, end_points(some))
    assert torch.equal(crossings, intersections(some))


@pytest.mark.parametrize("name", MASKS)
def test_drawn_masks_equal_the_torch_stages(name):
    assert_the_same(planes(mask(MASKS[name]), ~mask(MASKS[name])))


def test_every_neighbourhood_equals_the_torch_stages():
    assert_the_same(every_neighbourhood())


def noise(seed: int, height: int, width: int, density: int) -> Tensor:
    """Two images of pixels that are each on in about ``2 ** -density`` of the layers."""
    generator = torch.Generator().manual_seed(seed)
    some = torch.full((2, height, width), 255, dtype=torch.uint8)
    for _ in range(density):
        some &= torch.randint(256, some.shape, generator=generator, dtype=torch.uint8)
    return some


@given(
    seed=st.integers(0, 10_000),
    height=SIZES,
    width=SIZES,
    density=st.integers(1, 4),
    inverted=st.booleans(),
    radius=st.integers(0, 80),
    area=st.integers(0, 60),
)
def test_noise_equals_the_torch_stages(seed, height, width, density, inverted, radius, area):
    some = noise(seed, height, width, density)
    assert_the_same(~some if inverted else some, radius, area)


def test_large_regions_equal_the_torch_stages():
    """Thinned in many sub-iterations, across tiles and words."""
    some = noise(3, 260, 330, 3)
    assert_the_same(open_and_close(some, 0, 2), 3, 400)


def maps(seed: int, count: int, height: int, width: int, grain: int = 8) -> Tensor:
    """Label maps of ids 0 to 11."""
    some = [blobs(seed * count + number, height, width, grain) for number in range(count)]
    return torch.from_numpy(np.stack(some))


@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 90),
    width=st.integers(1, 300),
    data=st.data(),
    dtype=st.sampled_from([torch.uint8, torch.int16, torch.int32, torch.int64]),
)
def test_votes_equal_the_torch_stage(seed, height, width, data, dtype):
    grid = data.draw(st.integers(1, height)), data.draw(st.integers(1, width))
    labels = maps(seed, 2, height, width).to(dtype)
    table, origin = category_table(label_space(SPACE))
    got = torch.empty((2, *grid), dtype=torch.uint8)
    found = native.core().library.ssrvlad_vote(
        struct("labels")(labels.data_ptr(), labels.element_size(), *labels.shape),
        struct("table")(table.data_ptr(), len(table), origin),
        *grid,
        got.data_ptr(),
    )
    assert found == 0
    assert torch.equal(got, reduce_by_majority(categorise(labels, table, origin).int(), grid))


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
        SSRVLADConfig.from_preset(name.split(",")[0], labels_as=SPACE, **own)
        for name, own in CONFIGS.items()
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


def test_many_points_are_counted_by_rows_and_equal_the_torch_stages():
    """With this many points shape contexts are counted by rows, not by pairs."""
    bare = {"closing": 0.0, "hole_area": 0.0, "region_area": 0.0}
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE, **bare)
    assert_described(maps(8, 1, 150, 260, grain=2), config)


@configs
def test_dtype_and_memory_layout_change_nothing(config):
    labels = maps(5, 3, 133, 190)
    expected = describe(labels, config)
    for dtype in (torch.int8, torch.int16, torch.uint16, torch.int32, torch.int64):
        assert torch.equal(describe(labels.to(dtype), config), expected)
    turned = labels.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert torch.equal(describe(turned, config), expected)


def test_threads_and_batches_change_nothing():
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE)
    labels = maps(6, 7, 60, 90)
    expected = torch.cat([describe(image[None], config) for image in labels])
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert torch.equal(describe(labels, config), expected)
        with ThreadPoolExecutor(4) as pool:
            every = pool.map(lambda _: describe(labels, config), range(8))
            assert all(torch.equal(got, expected) for got in every)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("bad", [12, 255, -1, 1 << 40, -(1 << 40)])
@pytest.mark.parametrize("working_size", [None, 20])
def test_an_unknown_id_is_refused_with_its_count(bad, working_size):
    labels = maps(1, 2, 50, 60).to(torch.int64)
    labels[1, 3, 4] = bad
    config = SSRVLADConfig(labels_as=SPACE, working_size=working_size)
    with pytest.raises(ValueError, match=f"label id {bad} is not .*; 1 pixels"):
        describe(labels, config)


def test_the_operator_passes_opcheck():
    """Schema, fake kernel and ahead-of-time dispatch."""
    arguments = arguments_of(maps(2, 2, 40, 50), SSRVLADConfig(labels_as=SPACE))
    torch.library.opcheck(operator, arguments)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_library_has_the_presets_and_refuses_wrong_settings(preset, core):
    own, library = struct("settings")(), core.library
    assert library.ssrvlad_preset(preset.encode(), ctypes.byref(own)) == 0
    config = SSRVLADConfig.from_preset(preset)
    for name, _ in own._fields_:
        value = getattr(config, name)
        if isinstance(value, (float, int)):
            assert getattr(own, name) == value
    own.rings = 0
    assert library.ssrvlad_new_for(number("INTERFACE"), ctypes.byref(own)) is None
    assert library.ssrvlad_preset(b"other", ctypes.byref(own)) < 0


def test_a_few_seeds_are_in_range(core, tmp_path):
    library = Path(core.library._name)
    flags = ["-std=c++17", "-O1", "-pthread", f"-I{library.parent}", f"-Wl,-rpath,{library.parent}"]
    sources = [ROOT / "tests" / "fuzz.cpp", library]
    subprocess.run(["g++", *flags, *sources, "-o", tmp_path / "fuzz"], check=True)
    assert outcome(tmp_path / "fuzz", "0", "20") == (0, ["clean"], [])


@pytest.mark.slow
@pytest.mark.parametrize(
    "program", [("fuzz", "20", "300"), ("sanitised",)], ids=lambda line: line[0]
)
def test_sanitisers_find_nothing(program, tmp_path):
    name, *arguments = program
    folder = ROOT / "ssrvlad_torch" / "native"
    flags = ["-std=c++17", "-O0", "-ffp-contract=off", "-pthread", f"-I{folder}"]
    flags += ["-Wall", "-Wextra", "-Werror"]
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    sources = [ROOT / "tests" / f"{name}.cpp", *folder.glob("*.cpp")]
    subprocess.run(["g++", *flags, *checks, *sources, "-o", tmp_path / name], check=True)
    assert outcome(tmp_path / name, *arguments) == (0, ["clean"], [])


LOST = r"""
#include "filter.hpp"
using namespace places;

// A belief that cannot leave its rows, and a frame that is elsewhere: the frame starts anew.
int main() {
  const Drives drives{{0}, 100};
  Motion motion;
  motion.jump = motion.unmapped = 0;
  const Filter filter(drives, motion, {FORWARDS});
  const auto at = [](Size row) {
    Likelihood likelihood{std::vector<float>(100), 0};
    likelihood.rows[static_cast<std::size_t>(row)] = 9;
    return likelihood;
  };
  Belief first = filter.start(drives.all());
  filter.update(first, at(10));
  Belief second = filter.predicted(first, drives.all());
  const double gain = filter.update(second, at(60));
  if (!(std::abs(gain) < 1e-6) || !(second.of_rows()[60] > 0.999F)) return 1;
  const Future future = filter.before(first, drives.all(), at(60), filter.none(second));
  const auto [rows, unmapped] = filter.smoothed(first, future);
  return !(rows[10] > 0.999F && unmapped == 0);
}
"""


def test_a_frame_that_is_nowhere_by_the_belief_starts_it_anew(tmp_path):
    folder = ROOT / "ssrvlad_torch" / "native"
    (tmp_path / "lost.cpp").write_text(LOST)
    sources = [tmp_path / "lost.cpp", folder / "filter.cpp"]
    subprocess.run(
        ["g++", "-std=c++17", f"-I{folder}", *sources, "-o", tmp_path / "lost"], check=True
    )
    subprocess.run([tmp_path / "lost"], check=True)


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
