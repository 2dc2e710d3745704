"""The C++ package as other projects find it, and the page that says how to use it and its programs;
needs what the programs need, see `built.user`."""

import os
import re
import shlex
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import run_onnx
import torch
from built import commands, must
from exported import write_categories, write_city_in_space
from helpers import outcome, write_image
from networks import photo, write_graph
from PIL import Image
from ssrvlad_place.database import save
from ssrvlad_place.model import Description

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head

CONFIG = SSRVLADConfig(labels_as="camvid-11")

FRAMES = r"""
#include <ssrvlad/loops.hpp>
#include <ssrvlad/map.hpp>
#include <ssrvlad/place.hpp>

#include <sys/resource.h>
#include <thread>

// Whether a stream of descriptors of 4 MiB, 1024 in a block, says that 4 GiB are not enough for it.
bool is_short() {
  rlimit limit;
  getrlimit(RLIMIT_AS, &limit);
  limit.rlim_cur = rlim_t{1} << 32;
  setrlimit(RLIMIT_AS, &limit);
  ssrvlad::Described wide;
  wide.length = 1 << 20;
  wide.descriptor.resize(wide.length);
  try {
    ssrvlad::Loops({"wide", "", ""}).update("a/1", wide);
  } catch (const std::bad_alloc&) {
    return true;
  }
  return false;
}

int main(int, char** files) {
  const ssrvlad::Place place(files[1]);
  const std::vector<std::int64_t> labels(12 * 9, 0);
  ssrvlad::Described seen, same;
  std::thread other([&] { same = place.describe(labels.data(), 12, 9); });
  seen = place.describe(labels.data(), 12, 9);
  other.join();
  for (float number : seen.descriptor) std::printf("%.9g\n", number);
  ssrvlad::Loops loops(place.fingerprints());
  const ssrvlad::Map town(files[2], place.fingerprints());
  loops.update("a/1", seen);
  ssrvlad::Tracker tracker(town, 1), later(town, 1);
  tracker.update(seen);
  tracker.save(files[3]);
  later.load(files[3]);
  const auto answer = tracker.update(seen), again = later.update(seen);
  const bool goes_on = answer->query == 0 && !answer->settled && tracker.finish()->query == 1 &&
                       answer->candidates[0].score == again->candidates[0].score;
  const bool right = goes_on && town.locate(seen).found() && loops.size() == 1;
  return right && seen.descriptor == same.descriptor && is_short() ? 0 : 1;
}
"""
HEAD_OF_CORE = """
#include <ssrvlad/ssrvlad.h>
#include <cstdio>
int main() {
  ssrvlad_settings settings;
  ssrvlad_preset("default", &settings);
  ssrvlad_head* head = ssrvlad_new(&settings);
  std::puts(ssrvlad_fingerprint(head));
  ssrvlad_free(head);
}
"""


def consumer(folder, program, *lines):
    """The compiled program of a project that takes the package, without ORT_ROOT."""
    folder.mkdir()
    (folder / "main.cpp").write_text(program)
    head = "cmake_minimum_required(VERSION 3.16)", "project(consumer LANGUAGES CXX)"
    (folder / "CMakeLists.txt").write_text("\n".join((*head, *lines)))
    unset = ("env", "--unset=ORT_ROOT", "cmake")
    must(*unset, "-S", folder, "-B", folder / "build", "-DCMAKE_UNITY_BUILD=ON")
    must("cmake", "--build", folder / "build")
    return folder / "build" / "consumer"


PROGRAM = "add_executable(consumer main.cpp)"
GUIDE = Path(__file__).parents[1] / "docs" / "guides" / "onnx.md"
LISTINGS = re.findall(r"```cpp\n(.*?)```", GUIDE.read_text("utf-8"), re.DOTALL)


def found(user, component=""):
    """How CMake finds the installed package."""
    return f"find_package(ssrvlad REQUIRED {component} PATHS {user / 'installed'} NO_DEFAULT_PATH)"


def test_a_project_finds_the_installed_core(user, tmp_path):
    link = "target_link_libraries(consumer PRIVATE ssrvlad::core)"
    program = consumer(tmp_path / "c", HEAD_OF_CORE, found(user), PROGRAM, link)
    assert outcome(program) == (0, [CONFIG.fingerprint], [])


def test_a_project_finds_the_installed_core_by_pkg_config(user, tmp_path):
    if not shutil.which("pkg-config"):
        pytest.skip("pkg-config is not installed")
    (folder,) = (user / "installed").rglob("pkgconfig")
    paths = {**os.environ, "PKG_CONFIG_PATH": str(folder)}
    _, (flags,), _ = outcome("pkg-config", "--static", "--cflags", "--libs", "ssrvlad", env=paths)
    (tmp_path / "main.cpp").write_text(HEAD_OF_CORE)
    must("g++", tmp_path / "main.cpp", *flags.split(), "-o", tmp_path / "program")
    assert outcome(tmp_path / "program") == (0, [CONFIG.fingerprint], [])


def test_a_project_finds_the_installed_place(user, tmp_path):
    """Wide labels, from two threads; beside the listing of the guide."""
    link = "target_link_libraries(consumer PRIVATE ssrvlad::place)"
    main, package = "".join(LISTINGS) + FRAMES, found(user, "COMPONENTS place")
    program = consumer(tmp_path / "c", main, package, PROGRAM, link)
    export_head(CONFIG, tmp_path / "wide.onnx", dtype="int64")
    frames = map(Description, torch.eye(480)[:2].numpy())
    save(tmp_path / "two.npy", [*frames], ["a/0", "a/1"], {"ssr-vlad": CONFIG.fingerprint})
    code, lines, errors = outcome(
        program, tmp_path / "wide.onnx", tmp_path / "two.npy", tmp_path / "state"
    )
    assert (code, errors) == (0, [])
    expected = SSRVLAD(CONFIG)(np.zeros((1, 12, 9), np.int64))[0]
    np.testing.assert_allclose(np.array(lines, float), expected, atol=1e-6)


def test_the_commands_of_the_page_run(user, ssrvlad, main_of, monkeypatch):
    """Those of CMake built what is here, npm's and a GPU's are left out. The label
    space is another, for which other tests trace the heads."""
    monkeypatch.chdir(user)
    write_city_in_space(Path("city"), frames=33, size=(48, 64))
    for day, role in (("monday", "reference"), ("today", "query")):
        shutil.copytree(f"city/{role}", f"maps/{day}")
        for file in sorted(Path("maps", day).iterdir())[:4]:
            ids = np.asarray(Image.open(file))
            write_image(Path("photos", day, f"{file.stem}.ppm"), photo(ids))
    np.save("map.npy", ids)
    write_categories(Path("categories.npy"), "camvid-11")
    write_graph(Path("seg.onnx"), labels=True)
    Path("seg.yaml").write_text("network: seg.onnx\nlabels_as: camvid-11\n")
    here = {"ssrvlad": ssrvlad, "python": partial(main_of, run_onnx.main)}
    for typed in commands("ssrvlad", "python", "build"):
        if "CUDA" in typed or "512x1024" in typed:
            continue
        command = typed.replace("cityscapes-trainids", "camvid-11")
        program, *arguments = shlex.split(command)
        code, out, errors = here.get(program, partial(outcome, user / program))(*arguments)
        assert code == 0 and out, (command, errors)
