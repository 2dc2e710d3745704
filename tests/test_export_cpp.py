"""The C++ package and its programs against the module, and the page that says how to use them;
needs CMake, zlib and the headers of ONNX Runtime: in the folder that ORT_ROOT names, or as a CMake
package."""

import base64
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import run_onnx
import torch
from built import commands, must
from exported import edit_golden, turned, without_property, write_categories
from helpers import assert_each_is_one_line, outcome, street
from loop_streams import SEEDS, assert_same_answers, objects
from networks import photo, write_graph, write_town
from PIL import Image
from ssrvlad_place.database import save
from ssrvlad_place.model import Description

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head, match
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.deployment.fuse import fuse

CONFIG = SSRVLADConfig(labels_as="camvid-11")


@pytest.fixture(scope="module")
def build(user):
    """A folder with the programs, compiled."""
    return user / "build"


@pytest.fixture(scope="module")
def place(build):
    """The program."""
    return partial(outcome, build / "place")


@pytest.fixture(scope="module")
def follow(build):
    """The program for drives."""
    return partial(outcome, build / "follow")


@pytest.fixture(scope="module")
def loops(build):
    """The program for streams."""
    return partial(outcome, build / "loops")


def write_database(path, descriptors, folder):
    names = [f"{folder}/{number}" for number in range(len(descriptors))]
    save(path, [*map(Description, descriptors.numpy())], names, {"ssr-vlad": CONFIG.fingerprint})


@pytest.fixture
def town(tmp_path):
    """Six label maps as arrays, their descriptors as a database."""
    labels = np.stack([street(seed) for seed in range(6)])
    view = SSRVLAD(CONFIG).explain(torch.from_numpy(labels))
    write_database(tmp_path / "town.npy", view.descriptor, "maps")
    np.save(tmp_path / "map.npy", labels[2])
    Image.fromarray(labels[2]).save(tmp_path / "map.pgm")
    return view


def ranked(lines):
    """The frames that the program names, and their scores."""
    found = [line.split() for line in lines[1:]]
    return [frame for frame, _ in found], [float(score) for _, score in found]


@pytest.mark.parametrize("name", ["map.npy", "map.pgm"])
def test_the_program_prints_what_the_module_finds(place, head, town, tmp_path, name):
    code, lines, errors = place(head, tmp_path / name, tmp_path / "town.npy", 4)
    assert (code, errors) == (0, [])
    assert re.fullmatch(r"descriptor: 480 numbers, norm 1.000000, confidence \d\.\d\d", lines[0])
    scores, rows = (part[0].tolist() for part in match(town.descriptor[2:3], town.descriptor, 4))
    assert ranked(lines) == ([f"maps/{row}" for row in rows], pytest.approx(scores, abs=1e-5))


@pytest.fixture
def bad(town, tmp_path):
    """Files and folders that are refused."""
    base, labels = tmp_path / "town.npy", (tmp_path / "map.npy").read_bytes()
    np.save(tmp_path / "strange.npy", np.full((4, 5), 77, np.uint8))
    np.save(tmp_path / "wide.npy", np.zeros((4, 5), np.int64))
    write_categories(tmp_path / "categories.npy", "camvid-11")
    (tmp_path / "cut.npy").write_bytes(labels[:-1])
    Image.fromarray(photo(street(1, 30, 40))).save(tmp_path / "photo.jpg")
    np.save(tmp_path / "short.npy", np.zeros((6, 9), np.float32))
    np.save(tmp_path / "none.npy", np.zeros((0, 480), np.float32))
    for name in ("short", "none"):
        shutil.copy(f"{base}.fingerprint.txt", tmp_path / f"{name}.npy.fingerprint.txt")
    shutil.copy(f"{base}.frames.txt", tmp_path / "short.npy.frames.txt")
    for name in ("empty", "frames", "jpegs"):
        (tmp_path / name).mkdir()
    (tmp_path / "frames" / "map.npy").write_bytes(labels)
    shutil.copy(tmp_path / "photo.jpg", tmp_path / "jpegs")
    return tmp_path


WRONG_USE = {
    "place": [
        ("HEAD", "usage"),
        ("HEAD cut.npy", "the length does not fit"),
        ("HEAD strange.npy", "20 pixels have an id outside"),
        ("HEAD wide.npy", "takes uint8, got int64"),
        ("HEAD town.npy", "expected an (H, W) map"),
        ("HEAD map.npy map.npy", "expected an (R, D) array of float32"),
        ("none.onnx map.npy", "none.onnx"),
        ("--network HEAD HEAD map.npy", "expected a network and a head"),
        ("no.onnx nowhere.npy", "nowhere.npy does not exist"),
        ("no.onnx photo.jpg", "expected .ppm or .npy files; ImageMagick makes them of others: mog"),
        ("no.onnx map.npy no.npy", "no.npy: cannot be read"),
        ("no.onnx map.npy town.npy many", "TOP: expected a whole number from 1 to 999999999, got"),
        ("no.onnx map.npy town.npy 0", "TOP: expected a whole number from 1 to 999999999, got 0"),
    ],
    "follow": [
        ("HEAD town.npy 5", "usage: follow"),
        ("--strange HEAD town.npy 5 frames", "usage: follow"),
        ("HEAD town.npy 5 empty", "empty holds no frames"),
        ("HEAD town.npy 5 jpegs", "holds no frames: expected .pgm or .npy files; ImageMagick"),
        ("HEAD none.npy 5 frames", "none.npy holds no frames"),
        ("HEAD short.npy 5 frames", "a database of 480 numbers a frame, got 9"),
        ("no.onnx town.npy 0 frames", "TOP: expected a whole number from 1 to 999999999, got 0"),
        ("--online --delay -1 no.onnx town.npy 5 frames", "--delay: expected a whole number"),
        ("--delay 3 no.onnx town.npy 5 frames", "--delay: expected with --online"),
        ("no.onnx town.npy 5 nowhere", "nowhere does not exist"),
        ("no.onnx no.npy 5 frames", "no.npy: cannot be read"),
    ],
    "loops": [
        ("HEAD", "usage: loops"),
        ("--strange HEAD frames", "usage: loops"),
        ("HEAD empty", "empty holds no frames"),
        ("--memory no/x.npy HEAD frames", "x.npy: cannot be written"),
        ("--exclude few no.onnx frames", "--exclude: expected a whole number from 0"),
        ("--exclude 2.7 no.onnx frames", "--exclude: expected a whole number from 0"),
        ("--threshold -1 no.onnx frames", "expected a number from 0 to 1, got -1"),
        ("--threshold 2 no.onnx frames", "expected a number from 0 to 1, got 2"),
    ],
    "../build-describe/describe": [
        ("default categories.npy", "usage"),
        ("best categories.npy map.npy", "expected the preset default or paper, got best"),
        ("default map.npy map.npy", "expected (256,) uint8, got 2 axes"),
        ("default categories.npy nowhere.npy", "cannot be read"),
        ("default categories.npy strange.npy", "20 pixels have an id without"),
        ("default categories.npy short.npy", "got 2 axes of <f4"),
    ],
}


@pytest.mark.parametrize("program", WRONG_USE)
def test_wrong_use_is_one_line(build, head, bad, monkeypatch, program):
    """There is no file no.onnx: what an argument says is looked at before a model is loaded."""
    monkeypatch.chdir(bad)
    table = [
        ([head if word == "HEAD" else word for word in line.split()], message)
        for line, message in WRONG_USE[program]
    ]
    assert_each_is_one_line(partial(outcome, build / program), table, silent=False)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A network with the head in one file and in two, and a photograph."""
    folder = tmp_path_factory.mktemp("drive")
    network = write_graph(folder / "seg.onnx")
    fuse(network, CONFIG, folder / "place.onnx")
    fuse(network, CONFIG, folder / "net.onnx", folder / "head.onnx")
    np.save(folder / "photo.npy", photo(street(1, 60, 90)))
    return folder


def test_channels_of_another_network_or_of_one_side_only(place, drives, tmp_path):
    town, turned_signs = tmp_path / "town.npy", tmp_path / "turned.onnx"
    write_town(drives, town)
    np.save(tmp_path / "photo.npy", np.asarray(Image.open(drives / "today" / "5.png")))
    plain = without_property(drives / "place.onnx", tmp_path / "plain.onnx", "hog")
    code, lines, (line,) = place(plain, tmp_path / "photo.npy", town)
    assert (code, len(lines)) == (0, 6)
    assert line == f"only {town} has hog: frames are matched without; fuse the file again"
    Path(f"{town}.features.npy.fingerprint.txt").write_text("others\n")
    code, _, (line,) = place(drives / "place.onnx", tmp_path / "photo.npy", town)
    assert code == 2 and "features.npy has fingerprint others, the model 16 x 16" in line
    Path(f"{town}.features.npy").unlink()
    code, lines, (line,) = place(drives / "place.onnx", tmp_path / "photo.npy", town)
    assert (code, len(lines)) == (0, 6)
    assert line == "only the model has features: frames are matched without"
    edit_golden(drives / "place.onnx", turned_signs, turned("features"))
    code, _, (line,) = place(turned_signs, tmp_path / "photo.npy")
    assert code == 2 and " % of its features differ" in line and " 0.000000 % of its lab" in line


def test_a_runtime_that_gets_the_golden_pair_wrong_is_refused(place, drive, tmp_path):
    head = edit_golden(drive / "head.onnx", tmp_path / "head.onnx", turned("labels"))
    fused = edit_golden(drive / "place.onnx", tmp_path / "place.onnx", turned("image"))
    net = edit_golden(drive / "net.onnx", tmp_path / "net.onnx", turned("image"))
    photograph = drive / "photo.npy"
    for model in (
        [fused],
        ["--network", drive / "net.onnx", head],
        ["--network", net, drive / "head.onnx"],
    ):
        code, lines, (line,) = place(*model, photograph)
        assert (code, lines) == (2, [])
        assert "is computed wrong here: the golden pair differs by" in line
        assert place("--unchecked", *model, photograph)[0] == 0


def as_bytes(golden):
    """Records the descriptor as numbers of one byte."""
    content = zlib.compress(bytes(math.prod(golden["descriptor"]["shape"])))
    golden["descriptor"].update(dtype="uint8", data=base64.b64encode(content).decode())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda golden: golden["labels"].update(shape=[1 << 20, 1 << 20]), "than 64 MiB"),
        (lambda golden: golden["labels"].update(shape=[-1]), "the golden pair is damaged"),
        (lambda golden: golden["labels"].update(data="AAAA"), "the golden pair is damaged"),
        (lambda golden: golden["labels"].update(dtype="text"), "the golden pair is damaged"),
        (lambda golden: golden.pop("labels"), "no golden pair for input labels"),
        (lambda golden: golden.update(labels=3), "no golden pair for input labels"),
        (lambda golden: golden.pop("descriptor"), "no golden pair for input labels"),
        (as_bytes, "is computed wrong here"),
    ],
)
def test_a_damaged_golden_pair_is_one_line(place, drive, tmp_path, change, message):
    edit_golden(drive / "head.onnx", tmp_path / "x.onnx", change)
    np.save(tmp_path / "map.npy", np.zeros((4, 5), np.uint8))
    code, _, (line,) = place(tmp_path / "x.onnx", tmp_path / "map.npy")
    assert code == 2
    assert message in line and "x.onnx" in line


DESCR, ORDER = "'descr': '|u1', ", "'fortran_order': False, "


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (f"{{'descr': '{'u' * 400_000}', {ORDER}'shape': (4, 5)}}", "expected numbers of up to 8"),
        (f"{{{DESCR}{ORDER}'shape': ({'1, ' * 200_000})}}", "its header is damaged"),
        (f"{{{DESCR}{ORDER}'shape': ({'9' * 23}, 5)}}", "its header is damaged"),
        (f"{{{DESCR}{ORDER}'shape': ({2**40}, {2**40})}}", "the length does not fit the shape"),
        (f"{{{DESCR}{ORDER}}}", "its header is damaged"),
        (f"{{'descr': '>i4', {ORDER}'shape': (4, 5)}}", "little-endian, got >i4"),
        (f"{{'descr': [('x', '<i4')], {ORDER}'shape': (4, 5)}}", "of numbers, got records"),
        (f"{{{DESCR}'fortran_order': True, 'shape': (4, 5)}}", "expected C order"),
    ],
    ids=range(8),
)
def test_a_damaged_array_is_one_line(place, head, tmp_path, header, message):
    length = len(header).to_bytes(4, "little")
    content = b"\x93NUMPY\x02\x00" + length + header.encode() + bytes(20)
    (tmp_path / "x.npy").write_bytes(content)
    code, lines, (line,) = place(head, tmp_path / "x.npy")
    assert (code, lines) == (2, [])
    assert "x.npy: " in line and message in line


def test_a_picture_that_is_shorter_than_its_header_says_is_one_line(place, head, tmp_path):
    (tmp_path / "x.pgm").write_bytes(b"P5 1048576 1048576 255\n")
    assert place(head, tmp_path / "x.pgm")[2] == [f"place: {tmp_path / 'x.pgm'}: ends too early"]


def test_frames_have_the_order_and_the_ids_of_python(follow, main_of, head, town, tmp_path):
    """Of a folder, and of its files; of a second frame of one name a line says so."""
    drive = tmp_path / "drive"
    drive.mkdir()
    for name in ("10", "9", "001", "01", "1", "b2", "a10", "12.5", "12.25"):
        shutil.copy(tmp_path / "map.npy", drive / f"{name}.npy")
    shutil.copy(tmp_path / "map.npy", drive / "2.NPY")
    program = (head, drive, "--database", tmp_path / "town.npy", "--top", 1, "--json")
    expected = [line["query"] for line in objects(main_of(run_onnx.main, "x", *program)[1])]
    for sources in [drive], [*drive.glob("*.[nN]*")]:
        code, lines, errors = follow(head, tmp_path / "town.npy", 1, *sources)
        assert (code, errors) == (0, [])
        assert [json.loads(line)["query"] for line in lines] == expected
    code, _, errors = follow(head, tmp_path / "town.npy", 1, drive, drive / ".." / "drive")
    assert code == 3 and all(": a second frame drive/" in line for line in errors[:-1])


def test_output_that_cannot_be_written_is_an_error(build, head, town, stream, tmp_path):
    for program, arguments in (
        ("place", (head, tmp_path / "map.npy")),
        ("follow", (head, tmp_path / "town.npy", 1, stream)),
        ("loops", (head, stream)),
    ):
        command = " ".join(map(str, (build / program, *arguments)))
        code, _, (*_, line) = outcome("bash", "-c", f"{command} > /dev/full")
        assert (code, line) == (2, f"{program}: standard output cannot be written")


LOOPS = ("--exclude", 5, "--threshold", 0.7)


@pytest.fixture
def stream(tmp_path):
    """The label maps of `SEEDS` as arrays."""
    folder = tmp_path / "stream"
    folder.mkdir()
    for number, seed in enumerate(SEEDS):
        np.save(folder / f"{number}.npy", street(seed))
    return folder


def test_a_stream_is_saved_in_one_array_and_goes_on(loops, drives, head, stream, tmp_path):
    """As one that was not stopped; another model, and what is no such array, are refused."""
    memory, later = tmp_path / "memory.npy", tmp_path / "later"
    expected = [json.loads(line) for line in loops(*LOOPS, head, stream)[1]]
    later.mkdir()
    for number in range(45, len(SEEDS)):
        (stream / f"{number}.npy").rename(later / f"{number}.npy")
    given = (*LOOPS, "--memory", memory)
    code, lines, errors = loops(*given, head, stream)
    assert (code, len(lines), errors) == (0, 45, [])
    for file in later.iterdir():
        file.rename(stream / file.name)
    lines += loops(*given, head, stream)[1]
    assert_same_answers([json.loads(line) for line in lines], expected)
    saved = np.load(memory)
    assert saved["frame"].tolist() == [b"stream/%d" % number for number in range(len(SEEDS))]
    maps = torch.from_numpy(np.stack([street(seed) for seed in SEEDS]))
    np.testing.assert_allclose(saved["ssr-vlad"], SSRVLAD(CONFIG)(maps), atol=1e-6)
    np.testing.assert_array_equal(saved[CONFIG.fingerprint], saved["ssr-vlad"])
    assert np.isnan(saved["stamp"]).all()
    code, lines, errors = loops(*given, head, stream)
    omitted = f"omitted {len(SEEDS)} frames: {memory} has their ids"
    assert (code, lines, errors) == (0, [], [omitted])
    code, _, (line,) = loops("--memory", memory, drives / "place.onnx", stream)
    assert code == 2 and "memory.npy: other channels than the model has" in line
    for content, message in (
        (b"torn", "not a .npy file"),
        (memory.read_bytes()[:-1], "the length does not fit the shape"),
        (memory.read_bytes()[:100], "ends too early"),
        ((stream / "1.npy").read_bytes(), "not a saved stream"),
    ):
        memory.write_bytes(content)
        code, _, (line,) = loops("--memory", memory, head, stream)
        assert code == 2 and f"memory.npy: {message}" in line


def test_a_stream_that_is_interrupted_is_saved(build, head, stream, tmp_path):
    command = [build / "loops", "--memory", tmp_path / "memory.npy", head, stream]
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        lines = [first, *process.stdout]
    saved = np.load(tmp_path / "memory.npy")["frame"]
    assert [json.loads(line)["frame"].encode() for line in lines] == saved.tolist()
    assert process.returncode == (130 if len(lines) < len(SEEDS) else 0)


FRAMES = r"""
#include <ssrvlad/loops.hpp>
#include <ssrvlad/map.hpp>
#include <ssrvlad/place.hpp>

#include <thread>

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
  return right && seen.descriptor == same.descriptor ? 0 : 1;
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
    write_database(tmp_path / "two.npy", torch.eye(480)[:2], "a")
    code, lines, errors = outcome(
        program, tmp_path / "wide.onnx", tmp_path / "two.npy", tmp_path / "state"
    )
    assert (code, errors) == (0, [])
    expected = SSRVLAD(CONFIG)(np.zeros((1, 12, 9), np.int64))[0]
    np.testing.assert_allclose(np.array(lines, float), expected, atol=1e-6)


def test_the_commands_of_the_page_run(user):
    """Those of CMake built what is here, npm's and a GPU's are left out."""
    write_city(user / "city", frames=33, size=(48, 64))
    (user / "maps").mkdir()
    for day, role in (("monday", "reference"), ("today", "query")):
        shutil.copytree(user / "city" / role, user / "maps" / day)
        (user / "photos" / day).mkdir(parents=True)
        for file in sorted((user / "maps" / day).iterdir())[:4]:
            ids = np.asarray(Image.open(file))
            Image.fromarray(photo(ids)).save(user / "photos" / day / f"{file.stem}.ppm")
    np.save(user / "map.npy", np.asarray(Image.open(file)))
    write_categories(user / "categories.npy", "cityscapes-trainids")
    write_graph(user / "seg.onnx", labels=True)
    (user / "seg.yaml").write_text("network: seg.onnx\nlabels_as: cityscapes-trainids\n")
    for command in commands("ssrvlad", "python", "build"):
        if "CUDA" in command or "512x1024" in command:
            continue
        program, *arguments = shlex.split(command)
        programs = {"python": [sys.executable], "ssrvlad": [sys.executable, "-m", "ssrvlad_torch"]}
        must(*programs.get(program, [user / program]), *arguments, cwd=user)
