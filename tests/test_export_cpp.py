"""The programs in C++: what they read and refuse; their answers are held to the core by
conformance/. See `built.user` for what they need."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import run_onnx
import torch
from exported import write_categories
from helpers import assert_each_is_one_line, outcome, street
from loop_streams import SEEDS, assert_same_answers, objects
from networks import photo
from PIL import Image
from ssrvlad_place.database import save
from ssrvlad_place.model import Description

from ssrvlad_torch import SSRVLAD, SSRVLADConfig

CONFIG = SSRVLADConfig(labels_as="camvid-11")


@pytest.fixture(scope="module")
def build(user):
    """A folder with the programs, compiled."""
    return user / "build"


@pytest.fixture(scope="module")
def place(build):
    """The program."""
    return partial(outcome, build / "place")


@pytest.fixture
def town(tmp_path):
    """A label map in two forms, and a database of six."""
    labels = np.stack([street(seed) for seed in range(6)])
    descriptors, names = SSRVLAD(CONFIG)(labels).numpy(), [f"maps/{n}" for n in range(6)]
    path = tmp_path / "town.npy"
    save(path, [*map(Description, descriptors)], names, {"ssr-vlad": CONFIG.fingerprint})
    np.save(tmp_path / "map.npy", labels[2])
    Image.fromarray(labels[2]).save(tmp_path / "map.pgm")


def test_an_array_and_a_pgm_of_one_label_map_have_one_answer(place, head, town, tmp_path):
    first, second = (
        place(head, tmp_path / name, tmp_path / "town.npy", 4) for name in ("map.npy", "map.pgm")
    )
    assert first == second and (first[0], first[2]) == (0, [])
    pattern = r"descriptor: 480 numbers, norm 1.000000, confidence \d\.\d\d\nmaps/2 1\.0000\d*\n"
    assert re.match(pattern, "\n".join(first[1]))


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


def test_frames_have_the_order_and_the_ids_of_python(build, main_of, head, town, tmp_path):
    """Of a folder, and of its files; of a second frame of one name a line says so."""
    follow, drive = partial(outcome, build / "follow"), tmp_path / "drive"
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


@pytest.fixture
def live(build, head, tmp_path):
    """The program that finds loops, on names that come on standard input, and its memory."""

    @contextmanager
    def started():
        memory, pipes = tmp_path / "memory.npy", dict.fromkeys(("stdin", "stdout"), subprocess.PIPE)
        command = [*map(str, (build / "loops", "--memory", memory, head, "-"))]
        with subprocess.Popen(command, text=True, **pipes) as process:
            yield process, memory

    return started


def answer(process, path):
    """Waits for the line of a frame."""
    process.stdin.write(f"{path}\n")
    process.stdin.flush()
    return process.stdout.readline()


def test_a_stream_is_saved_in_one_array_and_goes_on(build, drives, head, stream, tmp_path):
    """As one that was not stopped; another model, and what is no such array, are refused."""
    memory, later = tmp_path / "memory.npy", tmp_path / "later"
    loops = partial(outcome, build / "loops")
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


@pytest.mark.parametrize(("sign", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stream_that_waits_for_a_name_ends_at_a_signal(live, stream, sign, code):
    with live() as (process, memory):
        answer(process, stream / "0.npy")
        process.send_signal(sign)
        assert process.wait(9) == code
    assert np.load(memory)["frame"].tolist() == [b"stream/0"]


def test_a_long_stream_is_saved_when_there_are_a_tenth_more_frames(live, stream):
    """Not after each 500 frames, so that what is written stays in proportion."""
    with live() as (process, memory):
        answer(process, stream / "0.npy")
    saved = np.repeat(np.load(memory), 5999)
    saved["frame"] = [b"old/%d" % number for number in range(5999)]
    np.save(memory, saved)
    with live() as (process, _):
        for number in (1, 2):
            answer(process, stream / f"{number}.npy")
        assert np.load(memory).size == 5999
    assert np.load(memory).size == 6001


def test_a_memory_that_is_there_but_cannot_be_read_is_refused(build, head, stream, monkeypatch):
    monkeypatch.chdir(stream.parent)
    with socket.socket(socket.AF_UNIX) as there:
        there.bind("memory.npy")
    code, _, (line,) = outcome(build / "loops", "--memory", "memory.npy", head, stream)
    assert (code, line) == (2, "loops: memory.npy: cannot be read")
    assert Path("memory.npy").is_socket()


def test_where_a_memory_cannot_be_written_the_old_one_stays_alone(build, head, stream, tmp_path):
    """On a disk that is full for larger files than 9 KiB."""
    memory, given = tmp_path / "out" / "memory.npy", (head, stream)
    memory.parent.mkdir()
    assert outcome(build / "loops", "--memory", memory, *given)[0] == 0
    before, command = memory.read_bytes(), [build / "loops", "--memory", memory, *given]
    limit = f"trap '' XFSZ; ulimit -f 9; exec {' '.join(map(str, command))}"
    assert outcome("bash", "-c", limit) == (2, [], [f"loops: {memory}: cannot be written"])
    assert [*memory.parent.iterdir()] == [memory] and memory.read_bytes() == before


def test_a_memory_is_on_the_disk_before_it_gets_its_name(build, head, stream, shim, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    recorded = {**os.environ, "LD_PRELOAD": str(shim), "RECORDED": str(out)}
    command = (build / "loops", "--memory", out / "memory.npy", head, stream / "0.npy")
    code, _, calls = outcome(*command, env=recorded)
    calls = [re.sub(r"\d+", "N", call) for call in calls if not call.startswith("write ")]
    expected = ["fsync /memory.npy.N.part", "rename /memory.npy", "fsync "]
    assert (code, calls) == (0, 2 * expected)
