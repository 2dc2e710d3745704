"""The adapter for RTAB-Map, called as its host calls it; pairs for hloc, and COLMAP itself on pairs
of ours."""

import importlib
import io
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses, street, write_image, write_maps, write_photos
from networks import photo

from ssrvlad_torch import SSRVLAD, SSRVLADConfig

EXPORT = Path(__file__).parents[1] / "export"
CONFIG = SSRVLADConfig(labels_as="camvid-11")
HEAD = SSRVLAD(CONFIG)

AS_THE_HOST = """
import importlib, sys
for name in ("torch", "kornia", "lance"):
    sys.modules[name] = None
del sys.argv
sys.path.append(".")
module = importlib.import_module("rtabmap_ssrvlad")
import numpy as np
module.init(480)
found = module.extract(np.load("image.npy"))
assert type(found) is np.ndarray and found.dtype == np.float32 and found.flags.c_contiguous
np.save("out.npy", found)
"""


def load(name, monkeypatch):
    """A script of export/, afresh."""
    monkeypatch.syspath_prepend(EXPORT)
    sys.modules.pop(name, None)
    return importlib.import_module(name)


def painted(labels):
    """Bytes as RTAB-Map hands them over: blue first, and said to be signed; most of the palette is
    above 127."""
    return np.ascontiguousarray(photo(labels)[..., ::-1]).view(np.int8)


LABELS = street(3)
WANTED = HEAD(torch.from_numpy(LABELS)[None]).numpy()


@pytest.fixture
def rtabmap(coloured, tmp_path, monkeypatch):
    """The script with a fused file beside its settings."""
    module = load("rtabmap_ssrvlad", monkeypatch)
    shutil.copy(coloured / "place.onnx", tmp_path)
    monkeypatch.setattr(module, "SETTINGS", tmp_path / "rtabmap_ssrvlad.json")
    return module


@pytest.mark.parametrize(
    ("settings", "dimension", "message"),
    [
        (None, 128, "gives 480 numbers; set PyDescriptor/Dim, 128"),
        ('{"model": "gone.onnx"}', 480, "gone.onnx does not exist"),
        ('{"model": "head.onnx"}', 480, "expected a file of `ssrvlad fuse`, whose input is images"),
        ('{"colour": [1]}', 480, "rtabmap_ssrvlad.json: no setting colour"),
        ("{", 480, "Expecting property name"),
    ],
)
def test_what_is_wrong_is_said_and_rtabmap_lives(
    rtabmap, head, tmp_path, capsys, settings, dimension, message
):
    shutil.copy(head, tmp_path / "head.onnx")
    if settings:
        rtabmap.SETTINGS.write_text(settings)
    rtabmap.init(dimension)
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    with pytest.raises(RuntimeError) as caught:
        rtabmap.extract(painted(LABELS))
    assert str(caught.value) == line


def test_images_of_another_form_are_refused(rtabmap):
    with pytest.raises(RuntimeError, match=r"init\(\) was not called"):
        rtabmap.extract(painted(LABELS))
    rtabmap.init(480)
    for image in (np.zeros((4, 5), np.int8), np.zeros((4, 5, 4), np.int8), np.zeros((4, 5, 3))):
        refuses(r"expected \(H, W, 3\) or \(H, W, 1\) bytes, got \(", rtabmap.extract, image)


def test_in_an_interpreter_without_arguments_and_without_torch(coloured, tmp_path):
    """As RTAB-Map does it: the folder is added to the path, the script imported by its name. Bytes
    above 127 are not negative."""
    shutil.copy(EXPORT / "rtabmap_ssrvlad.py", tmp_path)
    shutil.copytree(EXPORT / "ssrvlad_place", tmp_path / "ssrvlad_place")
    shutil.copy(coloured / "place.onnx", tmp_path)
    np.save(tmp_path / "image.npy", painted(LABELS))
    subprocess.run([sys.executable, "-c", AS_THE_HOST], cwd=tmp_path, check=True)
    found = np.load(tmp_path / "out.npy")
    assert found.shape == (1, 480)
    np.testing.assert_allclose(found, WANTED, atol=1e-6)


@pytest.fixture
def hloc(monkeypatch, main_of):
    """The script that writes pairs; its first argument is stdin."""
    module = load("hloc_pairs", monkeypatch)

    def run(stdin, *arguments):
        monkeypatch.setattr("sys.stdin", io.StringIO(stdin))
        return main_of(module.main, "hloc_pairs.py", *arguments)

    return run


def test_candidates_become_pairs_of_images(ssrvlad, database, tmp_path, hloc):
    """Through the command line, the frames of a database found again in a deeper folder."""
    queries = write_maps(tmp_path / "tuesday", range(2, 4))
    lines = ssrvlad("query", database, queries, "--top", 3, "--json")[1]
    write_photos(tmp_path / "images" / "db" / "monday", range(6), ".jpg")
    write_photos(tmp_path / "images" / "tuesday", range(2, 4))
    out = tmp_path / "pairs.txt"
    code, said, _ = hloc(lines, "--images", tmp_path / "images", "-o", out)
    assert (code, said) == (0, f"6 pairs: {out}\n")
    expected = [
        f"{line['query']}.png db/{each['frame']}.jpg"
        for line in map(json.loads, lines.splitlines())
        for each in line["candidates"]
    ]
    assert out.read_text() == "\n".join(expected)
    assert all((tmp_path / "images" / name).is_file() for name in " ".join(expected).split())
    assert [line[:11] for line in expected] == ["tuesday/002"] * 3 + ["tuesday/003"] * 3


def test_accepted_loops_become_pairs(tmp_path, hloc):
    lines = [
        {"frame": "a/0", "reason": "no_candidate", "candidate": None, "score": None},
        {"frame": "a/8", "reason": "accepted", "candidate": "a/0", "score": 0.9},
        {"frame": "a/9", "reason": "ambiguous", "candidate": "a/1", "score": 0.9},
        {"frames": 3, "precision": 1.0, "recall": 0.5},
    ]
    out = tmp_path / "pairs.txt"
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    assert hloc(text, "-o", out)[:2] == (0, f"1 pairs: {out}\n")
    assert out.read_text() == "a/8 a/0"


def test_a_frame_is_the_image_whose_path_ends_so(tmp_path, hloc):
    for drive, numbers in (("00", [1]), ("01", [1, 2])):
        write_photos(tmp_path / "images" / drive / "left", numbers, ".jpg")
    line = '{"query": "%s", "candidates": [{"frame": "00/left/001"}]}'
    out = tmp_path / "pairs.txt"
    for query, name in (("01/left/001", "01/left/001"), ("left/002", "01/left/002")):
        assert hloc(line % query, "--images", tmp_path / "images", "-o", out)[0] == 0
        assert out.read_text() == f"{name}.jpg 00/left/001.jpg"
    code, _, (error,) = hloc(line % "left/001", "--images", tmp_path / "images", "-o", out)
    assert code == 2 and "got 00/left/001.jpg and 01/left/001.jpg" in error


LOOP = '{"frame": "a/8", "reason": "accepted", "candidate": "a/0"}'


@pytest.mark.parametrize(
    ("stdin", "message"),
    [
        (LOOP, "expected one image of frame 'a/8' in {images}, got none"),
        (LOOP.replace("a/8", "b/1"), "frame 'b/1' in {images}, got b/1.jpg and b/1.png"),
        (f"{LOOP}\nnothing", "line 2: expected JSON of `ssrvlad query --json` or"),
        ('{"query": "a/8"}', "line 1: expected JSON"),
        ('{"candidates": [3]}', "line 1: expected JSON"),
        ("7", "line 1: expected JSON"),
        ('{"frame": "c/x y", "reason": "accepted", "candidate": "c/x y"}', "white space, got 'c/x"),
    ],
)
def test_wrong_lines_and_missing_images_are_told(tmp_path, hloc, stdin, message):
    images = tmp_path / "images"
    for name in ("b/1.jpg", "b/1.png", "c/x y.png"):
        write_image(images / name, np.zeros((4, 4), np.uint8))
    out = tmp_path / "pairs.txt"
    code, said, (error,) = hloc(stdin, "--images", images, "-o", out)
    assert (code, said, out.exists()) == (2, "", False)
    assert message.format(images=images) in error
