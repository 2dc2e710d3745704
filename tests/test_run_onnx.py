"""The script without torch against the command line."""

import sys
from functools import partial
from pathlib import Path

import loops_onnx
import numpy as np
import pytest
import run_onnx
from exported import without_property
from helpers import (
    assert_each_is_one_line,
    assert_no_reader_is_no_error,
    flip_byte,
    outcome,
    without,
    write_maps,
)
from loop_streams import objects
from networks import write_graph
from PIL import Image

from ssrvlad_torch import SSRVLADConfig, export_head

SCRIPT = Path(run_onnx.__file__)
CONFIG = SSRVLADConfig(labels_as="camvid-11")


def alone(*arguments):
    """Runs the script in a new process that has only what the page says."""
    return outcome(*without(DEPENDENCIES, SCRIPT, *arguments))


@pytest.fixture
def run(main_of):
    return partial(main_of, run_onnx.main, "run_onnx.py")


@pytest.fixture
def town(head, maps, tmp_path, run):
    """A database that the script wrote."""
    assert run(head, maps, "--save-descriptors", tmp_path / "town.npy")[0] == 0
    return tmp_path / "town.npy"


def assert_same(got, expected):
    """Queries and candidates of JSON lines; scores may differ in their last digits."""
    for line, right in zip(objects(got), objects(expected), strict=True):
        assert line["query"] == right["query"]
        for one, other in zip(line["candidates"], right["candidates"], strict=True):
            assert one["frame"] == other["frame"]
            assert one["score"] == pytest.approx(other["score"], abs=1e-5)


DEPENDENCIES = ("torch", "kornia", "lance", "pyarrow", "rich", "typer")
"""Of the package, which the programs do not need."""
SINGLE = ("--no-standardise", "--no-sweep", "--follow", "no")


def test_without_torch_it_finds_what_the_command_line_finds(ssrvlad, head, database, tmp_path):
    queries = write_maps(tmp_path / "tuesday", range(4, 9))
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", tmp_path / "t.npy")[0] == 0
    expected_lines = ssrvlad("query", database, queries, *SINGLE, "--top", 3, "--json")[1]
    arguments = (queries, "--database", tmp_path / "t.npy", "--top", 3, "--json")
    code, lines, errors = alone(head, *arguments)
    assert code == 0, errors
    assert_same("\n".join(lines), expected_lines)


def test_features_of_one_side_only_and_of_another_network(drives, tmp_path, run):
    town = tmp_path / "town.npy"
    frames = (drives / "today" / "5.png",)
    assert run(drives / "place.onnx", drives / "monday", "--save-descriptors", town)[0] == 0
    marker = Path(f"{town}.features.npy.fingerprint.txt")
    own = marker.read_text()
    marker.write_text("others\n")
    code, _, (line,) = run(drives / "place.onnx", *frames, "--database", town)
    assert code == 2
    assert f"features.npy has fingerprint others, the model {own.strip()}" in line
    Path(f"{town}.features.npy").unlink()
    code, out, (line,) = run(drives / "place.onnx", *frames, "--database", town)
    assert (code, out.startswith("today/5: monday/")) == (0, True)
    assert line == "only the model has features: frames are matched without"
    plain = without_property(drives / "place.onnx", tmp_path / "plain.onnx", "hog")
    line = run(plain, *frames, "--database", town)[2][-1]
    assert line == f"only {town} has hog: frames are matched without; fuse the file again"


def test_a_database_of_another_fingerprint_is_refused(head, maps, town, run):
    marker = Path(f"{town}.fingerprint.txt")
    marker.write_text("0123456789abcdef\n")
    code, out, (error,) = run(head, maps, "--database", town)
    assert (code, out) == (2, "")
    assert "0123456789abcdef" in error
    assert CONFIG.fingerprint in error
    marker.unlink()
    code, _, (warning,) = run(head, maps, "--database", town)
    assert code == 0
    assert "has no fingerprint" in warning


def test_unknown_ids_are_counted_and_skipped(head, maps, tmp_path, run):
    labels = np.zeros((20, 30), np.uint8)
    labels[3, :7] = 200
    Image.fromarray(labels).save(maps / "strange.png")
    code, out, errors = run(head, maps, "--save-descriptors", tmp_path / "out.npy")
    assert code == 3
    assert errors[0].endswith("7 of 600 pixels have an id outside label space camvid-11")
    assert errors[1] == "skipped 1 of 7 frames"
    assert "strange" not in out + Path(f"{tmp_path / 'out.npy'}.frames.txt").read_text()
    assert len(np.load(tmp_path / "out.npy")) == 6


def test_an_empty_frame_matches_nothing_and_is_no_candidate(head, maps, tmp_path, run):
    Image.fromarray(np.full((9, 9), 11, np.uint8)).save(maps / "void.png")
    out = tmp_path / "out.npy"
    assert run(head, maps, "--save-descriptors", out)[0] == 0
    lines = objects(run(head, maps, "--database", out, "--top", 9, "--json")[1])
    assert {line["query"]: line["empty"] for line in lines}["monday/void"]
    np.save(out, np.zeros_like(np.load(out)))
    said = run(head, maps, "--database", out)[1].splitlines()
    assert said[0] == "monday/000: no candidate (confidence 0.00)"
    assert said[-1] == "monday/void: empty"
    assert run(head, maps)[1].startswith("monday/000: described\n")
    assert all(len(line["candidates"]) == (0 if line["empty"] else 6) for line in lines)


def test_class_scores_and_wide_labels(maps, tmp_path, run):
    file = min(maps.iterdir())
    labels = np.asarray(Image.open(file))
    np.save(tmp_path / "scores.npy", np.eye(12, dtype=np.float32)[labels].transpose(2, 0, 1))
    np.save(tmp_path / "map.npy", labels.astype(np.int64))
    found = []
    for name, settings in (("map", {"dtype": "int64"}), ("scores", {"input": "logits"})):
        export_head(CONFIG, tmp_path / "head.onnx", **settings)
        out = tmp_path / f"{name}.out.npy"
        given = tmp_path / f"{name}.npy"
        assert run(tmp_path / "head.onnx", given, "--save-descriptors", out)[0] == 0
        assert run(tmp_path / "head.onnx", "--check")[0] == 0
        found.append(np.load(out))
    np.testing.assert_array_equal(*found)
    code, _, errors = run(tmp_path / "head.onnx", file)
    message = "expected scores (C, H, W) in a .npy file, got another kind"
    assert (code, errors[0]) == (3, f"{file}: {message}")


def test_wrong_use_is_one_line(head, maps, town, tmp_path, run):
    other = tmp_path / "other.onnx"
    write_graph(other)
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(head.read_bytes()[:1000])
    damaged = tmp_path / "damaged.npy"
    damaged.write_bytes(town.read_bytes())
    Path(f"{damaged}.frames.txt").write_text("a/1\n")
    flip_byte(damaged, 0)
    lonely = tmp_path / "lonely.npy"
    lonely.write_bytes(town.read_bytes())
    Path(f"{lonely}.fingerprint.txt").write_text(f"{CONFIG.fingerprint}\n")
    (tmp_path / "empty").mkdir()
    table = [
        ((tmp_path / "none.onnx", maps), "none.onnx does not exist"),
        ((tmp_path / "none.onnx",), "none.onnx does not exist"),
        ((other, maps), "no metadata ssrvlad.version: not a file of"),
        ((cut, maps), str(cut)),
        ((head, tmp_path / "nowhere"), "nowhere does not exist and matches no file"),
        ((head, tmp_path / "empty"), "empty holds no label maps; expected .png"),
        ((head, maps, "--database", tmp_path / "no.npy"), "no.npy does not exist"),
        ((head, maps, "--database", lonely), "lonely.npy.frames.txt does not exist; expected the"),
        ((head, maps, "--database", damaged), "damaged.npy: the magic string is not correct"),
        ((head, maps, "--database", head), f"{head}: the magic string is not correct"),
        ((head, maps, "--save-descriptors", tmp_path / "none" / "o.npy"), "none is no folder"),
        ((head, maps, "--provider", "Abacus"), "no provider Abacus; expected one of "),
    ]
    assert_each_is_one_line(run, table)
    Path(f"{town}.frames.txt").write_text("a/1\n")
    assert run(head, maps, "--database", town)[2][0].endswith("for 1 frames")
    assert run(head)[0] == run(head, maps, "--check")[0] == run(head, maps, "--top", 0)[0] == 2


@pytest.mark.parametrize("program", [run_onnx, loops_onnx])
def test_a_reader_that_has_enough_is_no_error(head, maps, town, program):
    given = () if program is loops_onnx else ("--database", town)
    assert_no_reader_is_no_error(sys.executable, program.__file__, head, maps, *given)
