"""What `run_onnx.py` and `place` of C++ both say of maps of other channels and of golden pairs that
come out wrong or are damaged."""

import base64
import math
import zlib
from pathlib import Path

import numpy as np
import pytest
import run_onnx
from exported import edit_golden, turned, without_property
from helpers import outcome, street, write_map
from networks import photo
from PIL import Image


@pytest.fixture(params=["run_onnx.py", "C++"])
def program(request, main_of):
    """Runs one: returns exit code, lines of stdout and of stderr for the words of a model, a frame
    and perhaps a map."""
    if request.param == "C++":
        place = request.getfixturevalue("user") / "build" / "place"
        return lambda *words: outcome(place, *words)

    def run(*words):
        *words, town = words if str(words[-1]).endswith("town.npy") else (*words, None)
        options = ("--database", town) if town else ()
        code, out, errors = main_of(run_onnx.main, "run_onnx.py", *words, *options)
        return code, out.splitlines(), errors

    return run


@pytest.fixture
def frame(drives, tmp_path):
    """A photo of ``today`` as an array."""
    np.save(tmp_path / "photo.npy", np.asarray(Image.open(drives / "today" / "5.png")))
    return tmp_path / "photo.npy"


def test_channels_of_another_network_or_of_one_side_only(program, frame, drives, ssrvlad, tmp_path):
    town, model = tmp_path / "town.npy", drives / "place.onnx"
    write_map(ssrvlad, town, drives / "monday", segmenter=drives / "net.yaml")
    plain = without_property(model, tmp_path / "plain.onnx", "hog")
    code, lines, (line,) = program(plain, frame, town)
    assert code == 0 and "monday/" in lines[-1]
    assert line == f"only {town} has hog: frames are matched without; fuse the file again"
    Path(f"{town}.features.npy.fingerprint.txt").write_text("others\n")
    code, _, (line,) = program(model, frame, town)
    assert code == 2 and "features.npy has fingerprint others, the model 16 x 16" in line
    Path(f"{town}.features.npy").unlink()
    code, lines, (line,) = program(model, frame, town)
    assert code == 0 and "monday/" in lines[-1]
    assert line == "only the model has features: frames are matched without"


def test_a_golden_pair_that_comes_out_otherwise_is_refused(program, coloured, drives, tmp_path):
    """The line names the file and what differs; --unchecked prints what the unaltered file does."""
    head = edit_golden(coloured / "head.onnx", tmp_path / "head.onnx", turned("labels"))
    fused = edit_golden(coloured / "place.onnx", tmp_path / "place.onnx", turned("image"))
    net = edit_golden(coloured / "net.onnx", tmp_path / "net.onnx", turned("image"))
    signs = edit_golden(drives / "place.onnx", tmp_path / "signs.onnx", turned("features"))
    np.save(tmp_path / "photo.npy", photo(street(1, 60, 90)))
    both = ["--network", coloured / "net.onnx", coloured / "head.onnx"]
    for model, unaltered, wrong, message in (
        ([fused], [coloured / "place.onnx"], fused, "89."),
        ([*both[:2], head], both, head, "differ"),
        (["--network", net, both[2]], both, net, "89."),
        ([signs], [drives / "place.onnx"], signs, "49."),
    ):
        code, lines, (line,) = program(*model, tmp_path / "photo.npy")
        assert (code, lines) == (2, [])
        name, _, difference = line.partition(" is computed wrong here")
        assert name.endswith(str(wrong)) and message in difference
        expected = program(*unaltered, tmp_path / "photo.npy")
        assert program("--unchecked", *model, tmp_path / "photo.npy") == expected
        assert expected[0] == 0


def as_bytes(golden):
    """Records the descriptor as numbers of one byte."""
    content = zlib.compress(bytes(math.prod(golden["descriptor"]["shape"])))
    golden["descriptor"].update(dtype="uint8", data=base64.b64encode(content).decode())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda golden: golden["labels"].update(shape=[1 << 20, 1 << 20]), "64 MiB"),
        (lambda golden: golden["labels"].update(shape=[-1]), "golden"),
        (lambda golden: golden["labels"].update(data="AAAA"), "golden"),
        (lambda golden: golden["labels"].update(dtype="text"), "golden"),
        (lambda golden: golden.pop("labels"), "no golden pair for input labels"),
        (lambda golden: golden.update(labels=3), "golden"),
        (lambda golden: golden.pop("descriptor"), "no golden pair for input labels"),
        (as_bytes, "is computed wrong here"),
    ],
)
def test_a_damaged_golden_pair_is_one_line(program, coloured, tmp_path, change, message):
    edit_golden(coloured / "head.onnx", tmp_path / "x.onnx", change)
    np.save(tmp_path / "map.npy", np.zeros((4, 5), np.uint8))
    code, lines, (line,) = program(tmp_path / "x.onnx", tmp_path / "map.npy")
    assert (code, lines) == (2, [])
    assert message in line and line.startswith(("run_onnx: ", f"place: {tmp_path / 'x.onnx'}"))
