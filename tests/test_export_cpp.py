"""The C++ header and its example against the module; needs CMake, zlib and the headers of ONNX
Runtime: in the folder that ORT_ROOT names, or as a CMake package."""

import base64
import json
import math
import os
import shutil
import signal
import subprocess
import zlib
from functools import partial
from pathlib import Path

import follow_onnx
import loops_onnx
import numpy as np
import pytest
import torch
from graphs import edit_golden, turned, without_property
from helpers import assert_each_is_one_line, outcome, street
from loop_streams import SEEDS, assert_same_answers, objects
from networks import photo, write_graph
from PIL import Image
from segmenting import write_drives, write_map, write_town
from ssrvlad_place.database import save
from ssrvlad_place.model import Seen

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head, match
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.segmentation.segmenter import Segmenter

SOURCE = Path(__file__).parents[1] / "export" / "cpp"
CONFIG = SSRVLADConfig(labels_as="camvid-11")
STRICT = "-DCMAKE_CXX_FLAGS=-Wall -Wextra -Werror"


def cmake(*arguments):
    """Must succeed."""
    code, out, errors = outcome("cmake", *arguments)
    assert code == 0, out + errors


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """A folder with the program, compiled."""
    if not shutil.which("cmake"):
        pytest.skip("CMake is not installed")
    folder = tmp_path_factory.mktemp("build")
    code, _, errors = outcome("cmake", "-S", SOURCE, "-B", folder, STRICT)
    if code:
        assert "ORT_ROOT" not in os.environ, errors
        assert any(name in line for name in ("onnxruntime", "ZLIB") for line in errors), errors
        pytest.skip(
            "the C++ headers of ONNX Runtime or zlib are not installed; ORT_ROOT names their folder"
        )
    cmake("--build", folder)
    return folder


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
    save(path, [*map(Seen, descriptors.numpy())], names, {"ssr-vlad": CONFIG.fingerprint})


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
    assert lines[0] == "descriptor: 480 numbers, norm 1.000000"
    scores, rows = (part[0].tolist() for part in match(town.descriptor[2:3], town.descriptor, 4))
    assert ranked(lines) == ([f"maps/{row}" for row in rows], pytest.approx(scores, abs=1e-5))


def test_wrong_use_is_one_line(place, head, town, tmp_path):
    labels, base = (tmp_path / n for n in ("map.npy", "town.npy"))
    np.save(tmp_path / "strange.npy", np.full((4, 5), 77, np.uint8))
    np.save(tmp_path / "wide.npy", np.zeros((4, 5), np.int64))
    (tmp_path / "cut.npy").write_bytes(labels.read_bytes()[:-1])
    table = [
        ((head,), "usage"),
        ((tmp_path / "none.onnx", labels), "none.onnx"),
        ((head, tmp_path / "none.npy"), "cannot be read"),
        ((head, base), "expected an (H, W) map"),
        ((head, tmp_path / "cut.npy"), "the length does not fit"),
        ((head, tmp_path / "strange.npy"), "20 pixels have an id outside"),
        ((head, tmp_path / "wide.npy"), "takes uint8, got int64"),
        ((head, labels, labels), "expected an (R, D) array of float32"),
        (("--network", head, head, labels), "expected a network and a head"),
        ((head, labels, base, "many"), "TOP"),
        ((head, labels, base, 0), "TOP"),
    ]
    assert_each_is_one_line(place, table, silent=False)
    (tmp_path / "town.npy.fingerprint.txt").write_text("0123456789abcdef")
    assert "do not compare" in place(head, labels, base)[2][0]


def test_a_file_of_fixed_size_takes_no_other(place, town, tmp_path):
    labels = np.load(tmp_path / "map.npy")
    fixed = tmp_path / "fixed.onnx"
    export_head(CONFIG, fixed, "labels", "int32", (), (1, *labels.shape))
    for name, ids in {"same": labels, "other": labels[:, 1:]}.items():
        np.save(tmp_path / f"{name}.npy", ids.astype(np.int32))
    code, lines, _ = place(fixed, tmp_path / "same.npy", tmp_path / "town.npy", 1)
    assert (code, lines[1]) == (0, "maps/2 1.000000")
    size = f"takes {labels.shape[1]} columns, got"
    for name, message in (("map", "takes int32, got uint8"), ("other", size)):
        code, _, errors = place(fixed, tmp_path / f"{name}.npy")
        assert code == 2
        assert message in errors[0]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A network with the head in one file and in two, three photographs, their descriptors."""
    folder = tmp_path_factory.mktemp("drive")
    network = write_graph(folder / "seg.onnx")
    fuse(network, CONFIG, folder / "place.onnx")
    fuse(network, CONFIG, folder / "net.onnx", folder / "head.onnx")
    pixels = [photo(street(seed, 60, 90)) for seed in range(3)]
    np.save(folder / "photo.npy", pixels[1])
    Image.fromarray(pixels[1]).save(folder / "photo.ppm")
    labels = np.stack(Segmenter.load(network, CONFIG.labels_as)(pixels))
    write_database(folder / "town.npy", SSRVLAD(CONFIG)(labels), "photos")
    return folder


@pytest.mark.parametrize("name", ["photo.npy", "photo.ppm"])
@pytest.mark.parametrize("model", [["place.onnx"], ["--network", "net.onnx", "head.onnx"]])
def test_photographs_find_their_place_with_one_file_and_with_two(place, drive, model, name):
    named = [drive / part if part.endswith(".onnx") else part for part in model]
    code, lines, errors = place(*named, drive / name, drive / "town.npy")
    assert (code, errors) == (0, ["only the model has hog: frames are matched without"])
    frames, scores = ranked(lines)
    assert (frames[0], scores[0], len(frames)) == ("photos/1", pytest.approx(1, abs=1e-6), 3)


def test_a_photograph_of_fewer_steps_of_light_is_refused(place, drive, tmp_path):
    (tmp_path / "dim.ppm").write_bytes(b"P6 1 1 100 abc")
    code, _, (line,) = place(drive / "place.onnx", tmp_path / "dim.ppm")
    assert code == 2 and "dim.ppm: expected a binary PPM whose largest value is 255, " in line


def test_features_are_fused_with_the_descriptor_as_in_python(place, drives, tmp_path):
    """With one file and with two."""
    town = tmp_path / "town.npy"
    for number, (frames, scores) in enumerate(write_town(drives, town), 3):
        np.save(tmp_path / "photo.npy", np.asarray(Image.open(drives / "today" / f"{number}.png")))
        for model in ("place.onnx",), ("--network", drives / "net.onnx", "head.onnx"):
            given = (*model[:-1], drives / model[-1], tmp_path / "photo.npy", town)
            code, lines, errors = place(*given)
            assert (code, errors) == (0, [])
            assert ranked(lines) == (frames, pytest.approx(scores, abs=1e-5))


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
        (lambda golden: golden["labels"].update(shape=[-1]), "than 64 MiB"),
        (lambda golden: golden["labels"].update(data="AAAA"), "the golden pair is damaged"),
        (lambda golden: golden["labels"].update(dtype="text"), "the golden pair is damaged"),
        (lambda golden: golden.pop("labels"), "no golden pair for input labels"),
        (lambda golden: golden.update(labels=3), "the golden pair is damaged"),
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
    """Files of one folder, a folder named twice, another spelling of it, and a second frame."""
    drive = tmp_path / "drive"
    drive.mkdir()
    for name in ("10", "9", "001", "01", "1", "b2", "a10", "12.5", "12.25"):
        shutil.copy(tmp_path / "map.npy", drive / f"{name}.npy")
    shutil.copy(tmp_path / "map.npy", drive / "2.NPY")
    shutil.copy(tmp_path / "map.npy", drive / "9.NPY")
    for sources in ([drive], [*drive.glob("*.npy")], [drive, drive / ".." / "drive"]):
        code, lines, errors = follow(head, tmp_path / "town.npy", 1, *sources)
        program = (head, *sources, "--database", tmp_path / "town.npy", "--top", 1, "--json")
        expected, out, _ = main_of(follow_onnx.main, "x", *program)
        told = [[json.loads(line)["query"] for line in some] for some in (lines, out.splitlines())]
        assert code == expected and told[0] == told[1]
        assert all(": a second frame drive/" in line for line in errors[:-1])
        assert bool(errors) == (code == 3) == (len(sources) < 9)


def test_a_database_that_was_written_on_windows_is_read(place, head, town, tmp_path):
    base = tmp_path / "town.npy"
    expected = place(head, tmp_path / "map.npy", base, 4)
    for name in ("frames", "fingerprint"):
        file = Path(f"{base}.{name}.txt")
        file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
    assert place(head, tmp_path / "map.npy", base, 4) == expected


def test_output_that_cannot_be_written_is_an_error(build, head, town, stream, tmp_path):
    for program, arguments in (
        ("place", (head, tmp_path / "map.npy")),
        ("follow", (head, tmp_path / "town.npy", 1, stream)),
        ("loops", (head, stream)),
    ):
        command = " ".join(map(str, (build / program, *arguments)))
        code, _, (*_, line) = outcome("bash", "-c", f"{command} > /dev/full")
        assert (code, line) == (2, f"{program}: standard output cannot be written")


def as_arrays(folder, source):
    """The frames of a folder as arrays, which C++ reads."""
    folder.mkdir()
    for file in source.iterdir():
        np.save(folder / f"{file.stem}.npy", np.asarray(Image.open(file)))
    return folder


def assert_as_in_python(lines, expected):
    """The lines of `follow_onnx.py --json`, but for the last digits of numbers."""
    for line, right in zip(map(json.loads, lines), map(json.loads, expected), strict=True):
        assert [*line] == [*right]
        (scores, others) = (
            [each["score"] for each in told.pop("candidates")] for told in (line, right)
        )
        assert scores == pytest.approx(others, abs=1e-5)
        assert line.pop("confidence") == pytest.approx(right.pop("confidence"), abs=1e-5)
        assert line == right


@pytest.mark.parametrize(
    ("options", "given"),
    [
        ((), ()),
        (("--online", 3), ("--follow", "online", "--delay", 3)),
        (("--alone",), ("--follow", "no")),
    ],
)
def test_drives_of_label_maps_are_followed_as_in_python(
    follow, main_of, ssrvlad, tmp_path, options, given
):
    """Two drives, from several anchors, in a map of two."""
    city = write_city(tmp_path / "city", frames=40, size=(60, 80), seed=3)
    other = write_city(tmp_path / "b", frames=12, size=(60, 80), seed=1)
    maps = city / "reference", (other / "reference").rename(tmp_path / "other")
    town = tmp_path / "town.npy"
    database = write_map(ssrvlad, town, *maps)
    config = SSRVLADConfig(labels_as="cityscapes-trainids")
    export_head(config, tmp_path / "head.onnx", columns=COLUMNS)
    drives = [
        as_arrays(tmp_path / "q1", city / "query"),
        as_arrays(tmp_path / "q2", other / "query"),
    ]
    code, lines, errors = follow(*options, tmp_path / "head.onnx", town, 3, *drives)
    assert (code, errors) == (0, [])
    program = (tmp_path / "head.onnx", *drives, "--database", town, "--top", 3, "--json", *given)
    assert_as_in_python(lines, main_of(follow_onnx.main, "x", *program)[1].splitlines())
    found = [json.loads(line)["candidates"][0]["frame"] for line in lines]
    expected = objects(ssrvlad("query", database, *drives, "--top", 3, "--json", *given)[1])
    assert found == [line["candidates"][0]["frame"] for line in expected]


def test_drives_of_pictures_are_followed_by_all_channels_as_in_python(follow, main_of, tmp_path):
    """With one file and with two; a file that is torn is skipped."""
    write_drives(tmp_path, range(36), range(2, 35), (96, 128))
    town, drive = tmp_path / "town.npy", as_arrays(tmp_path / "drive", tmp_path / "today")
    write_town(tmp_path, town)
    (drive / "9.npy").write_bytes(b"torn")
    program = (tmp_path / "place.onnx", drive, "--database", town, "--json")
    expected = main_of(follow_onnx.main, "x", *program)[1].splitlines()
    for model in (["place.onnx"], ["--network", tmp_path / "net.onnx", "head.onnx"]):
        code, lines, errors = follow(*model[:-1], tmp_path / model[-1], town, 5, drive)
        torn = f"{drive / '9.npy'}: not a .npy file"
        assert (code, errors) == (3, [torn, "skipped 1 of 33 frames"])
        assert_as_in_python(lines, expected)
    found = {line["query"]: line["candidates"][0]["frame"] for line in map(json.loads, lines)}
    assert all(place == query.replace("drive", "monday") for query, place in found.items())


def test_wrong_use_of_follow_is_one_line(follow, head, town, tmp_path):
    base, maps = tmp_path / "town.npy", tmp_path / "frames"
    maps.mkdir()
    shutil.copy(tmp_path / "map.npy", maps)
    np.save(tmp_path / "short.npy", np.zeros((6, 9), np.float32))
    shutil.copy(f"{base}.frames.txt", tmp_path / "short.npy.frames.txt")
    shutil.copy(f"{base}.fingerprint.txt", tmp_path / "short.npy.fingerprint.txt")
    np.save(tmp_path / "none.npy", np.zeros((0, 480), np.float32))
    (tmp_path / "none.npy.frames.txt").touch()
    (tmp_path / "none.npy.fingerprint.txt").write_text(f"{CONFIG.fingerprint}\n")
    (tmp_path / "empty").mkdir()
    table = [
        ((head, base, 5), "usage: follow"),
        (("--strange", head, base, 5, maps), "usage: follow"),
        ((head, base, "many", maps), "TOP: expected a whole number from 1 to 999999999, got many"),
        ((head, base, 0, maps), "TOP: expected a whole number from 1 to 999999999, got 0"),
        (("--online", -1, head, base, 5, maps), "DELAY: expected a whole number from 0"),
        ((head, base, 5, tmp_path / "nowhere"), "nowhere does not exist"),
        ((head, base, 5, tmp_path / "empty"), "empty holds no frames"),
        ((head, tmp_path / "no.npy", 5, maps), "no.npy: cannot be read"),
        ((head, tmp_path / "none.npy", 5, maps), "none.npy holds no frames"),
        ((head, tmp_path / "short.npy", 5, maps), "a database of 480 numbers a frame, got 9"),
    ]
    assert_each_is_one_line(follow, table)


LOOPS = ("--exclude", 5, "--threshold", 0.7)


@pytest.fixture
def stream(tmp_path):
    """The label maps of `SEEDS` as arrays."""
    folder = tmp_path / "stream"
    folder.mkdir()
    for number, seed in enumerate(SEEDS):
        np.save(folder / f"{number}.npy", street(seed))
    return folder


def test_loops_of_label_maps_are_those_of_python_and_of_the_command(
    loops, main_of, ssrvlad, head, stream
):
    code, lines, errors = loops(*LOOPS, head, stream)
    assert (code, errors) == (0, [])
    got = [json.loads(line) for line in lines]
    assert sum(line["reason"] == "accepted" for line in got) > 3
    assert_same_answers(got, objects(main_of(loops_onnx.main, "x", head, stream, *LOOPS)[1]))
    command = "loops", stream, "--labels-as", "camvid-11", *LOOPS, "--no-sweep", "--json"
    assert_same_answers(got, objects(ssrvlad(*command)[1]))


def test_loops_of_pictures_are_closed_by_all_channels_as_in_python(loops, main_of, tmp_path):
    """With one file and with two; a file that is torn is skipped."""
    write_drives(tmp_path, range(20), range(4, 18), (96, 128))
    drives = [
        as_arrays(tmp_path / new, tmp_path / old) for new, old in (("a", "monday"), ("b", "today"))
    ]
    (drives[0] / "9.npy").write_bytes(b"torn")
    program = (tmp_path / "place.onnx", *drives, *LOOPS)
    expected = objects(main_of(loops_onnx.main, "x", *program)[1])
    assert sum(line["reason"] == "accepted" for line in expected) > 3
    for model in (["place.onnx"], ["--network", tmp_path / "net.onnx", "head.onnx"]):
        code, lines, errors = loops(*LOOPS, *model[:-1], tmp_path / model[-1], *drives)
        torn = f"{drives[0] / '9.npy'}: not a .npy file"
        assert (code, errors) == (3, [torn, "skipped 1 of 34 frames"])
        assert_same_answers([json.loads(line) for line in lines], expected)


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
    assert code == 2 and "memory.npy has other" in line
    for content, message in (
        (b"torn", "not a saved stream"),
        (memory.read_bytes()[:-1], "the length does not fit the shape"),
        (memory.read_bytes()[:100], "ends too early"),
        ((stream / "1.npy").read_bytes(), "not a saved stream"),
    ):
        memory.write_bytes(content)
        code, _, (line,) = loops("--memory", memory, head, stream)
        assert code == 2 and f"memory.npy: {message}" in line


def test_wrong_use_of_loops_is_one_line(loops, head, stream, tmp_path):
    (tmp_path / "empty").mkdir()
    table = [
        ((head,), "usage: loops"),
        (("--strange", head, stream), "usage: loops"),
        (("--exclude", "few", head, stream), "--exclude: expected a whole number from 0"),
        (("--exclude", 2.7, head, stream), "--exclude: expected a whole number from 0"),
        (("--threshold", -1, head, stream), "expected a number from 0 to 1, got -1"),
        (("--threshold", 2, head, stream), "expected a number from 0 to 1, got 2"),
        ((head, tmp_path / "empty"), "empty holds no frames"),
        (("--memory", tmp_path / "no" / "x.npy", head, stream), "x.npy: cannot be written"),
    ]
    assert_each_is_one_line(loops, table)


def test_a_stream_that_is_interrupted_is_saved(build, head, stream, tmp_path):
    command = [build / "loops", "--memory", tmp_path / "memory.npy", head, stream]
    with subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True) as process:
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        lines = [first, *process.stdout]
    saved = np.load(tmp_path / "memory.npy")["frame"]
    assert [json.loads(line)["frame"].encode() for line in lines] == saved.tolist()
    assert process.returncode == (130 if len(lines) < len(SEEDS) else 0)


CONSUMER = r"""
#include <ssrvlad/loops.hpp>
#include <ssrvlad/map.hpp>
#include <thread>

// Whether a job is refused with a reason that has some words.
template <typename Job>
bool refused(const Job& job, const std::string& words) {
  try {
    job();
  } catch (const std::runtime_error& error) {
    return std::string(error.what()).find(words) != std::string::npos;
  }
  return false;
}

int main(int count, char** files) {
  if (count < 2) return ssrvlad::Loops({}).size() != 0;
  const ssrvlad::Place place(files[1]);
  if (count > 3) {  // frames as no model describes them; the stream stays as it was
    const std::vector<std::int64_t> labels(12 * 9, 0);
    auto seen = place.describe(labels.data(), 12, 9), other = seen;
    ssrvlad::Loops loops(place.fingerprints());
    const ssrvlad::Map town(files[2], place.fingerprints());
    other.descriptor.assign(479, 1.0F);
    other.length = 479;
    bool right = refused([&] { loops.update("a/1", other); }, "length 1");
    right = right && refused([&] { loops.update("a/1", {}); }, "as of Place::describe");
    other = seen;
    other.features.resize(3);
    right = right && refused([&] { loops.update("a/1", other); }, "as of Place::describe");
    const auto online = ssrvlad::Follow::kOnline;
    right = right && refused([&] { town.query({seen}, online, -1); }, "a delay from 0");
    right = right && refused([&] { town.locate(seen, 0); }, "expected 1 candidate or more");
    std::fill(other.descriptor.begin(), other.descriptor.end(), 0.0F);
    right = right && !town.locate(other).found() && town.locate(seen, std::size_t{1} << 62).found();
    loops.update("a/1", seen);
    return !right || loops.size() != 1;
  }
  if (count > 2) return ssrvlad::Map(files[2], place.fingerprints()).size() != 2;
  const std::vector<std::int64_t> labels(12 * 9, 0);
  ssrvlad::Described found[2];
  std::thread other([&] { found[1] = place.describe(labels.data(), 12, 9); });
  found[0] = place.describe(labels.data(), 12, 9);
  other.join();
  for (float number : found[0].descriptor) std::printf("%.9g\n", number);
  return found[0].descriptor == found[1].descriptor ? 0 : 1;
}
"""


def test_a_project_finds_the_installed_package(build, tmp_path):
    """Wide labels, from two threads."""
    installed, source, made = (tmp_path / name for name in ("installed", "source", "made"))
    cmake("--install", build, "--prefix", installed)
    source.mkdir()
    (source / "main.cpp").write_text(CONSUMER)
    (source / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(consumer LANGUAGES CXX)\n"
        "find_package(ssrvlad_place 1.0 REQUIRED)\nfind_package(Threads REQUIRED)\n"
        "add_executable(consumer main.cpp)\n"
        "target_link_libraries(consumer PRIVATE ssrvlad::map Threads::Threads)\n"
    )
    cmake("-S", source, "-B", made, STRICT, f"-DCMAKE_PREFIX_PATH={installed}")
    cmake("--build", made)
    export_head(CONFIG, tmp_path / "wide.onnx", dtype="int64")
    code, lines, errors = outcome(made / "consumer", tmp_path / "wide.onnx")
    assert (code, errors) == (0, [])
    expected = SSRVLAD(CONFIG)(np.zeros((1, 12, 9), np.int64))[0]
    np.testing.assert_allclose(np.array(lines, float), expected, atol=1e-6)
    write_database(tmp_path / "two.npy", torch.eye(480)[:2], "a")
    assert outcome(made / "consumer", tmp_path / "wide.onnx", tmp_path / "two.npy") == (0, [], [])
    assert outcome(made / "consumer", tmp_path / "wide.onnx", tmp_path / "two.npy", "x")[0] == 0
    assert outcome(made / "consumer")[0] == 0
    header = installed / "include" / "ssrvlad" / "ssrvlad.h"
    header.write_text(header.read_text().replace("SSRVLAD_INTERFACE 3", "SSRVLAD_INTERFACE 4"))
    cmake("--build", made)
    code, _, errors = outcome(made / "consumer", tmp_path / "wide.onnx", tmp_path / "two.npy")
    assert code and "the library ssrvlad has interface 3, the program is of 4" in "".join(errors)
    assert outcome(made / "consumer")[0] != 0
