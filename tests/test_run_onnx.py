"""`run_onnx.py`, the script without torch: against the command line, what it reads and refuses."""

import errno
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import loops_onnx
import numpy as np
import pytest
import run_onnx
from exported import FIXED, edit_golden, without_property
from helpers import (
    assert_each_is_one_line,
    assert_no_reader_is_no_error,
    flip_byte,
    outcome,
    refuses,
    street,
    without,
)
from loop_streams import objects
from networks import photo, write_graph
from PIL import Image
from ssrvlad_place.golden import run_golden
from ssrvlad_place.model import TRUST, Model, Split

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.label_shapes import LabelShapes

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


DEPENDENCIES = ("torch", "kornia", "lance", "pyarrow", "rich", "typer")
"""Of the package, which the programs do not need."""


def test_it_runs_without_torch(head, maps, town):
    code, lines, errors = alone(head, maps, "--database", town, "--json")
    assert (code, errors) == (0, [])
    assert [line["candidates"][0]["frame"] for line in objects("\n".join(lines))] == [
        f"monday/{n:03d}" for n in range(6)
    ]


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


def test_a_database_that_cannot_be_written_leaves_the_earlier_one(
    head, maps, town, tmp_path, run, monkeypatch
):
    np.save(f"{town}.poses.npy", np.zeros((6, 3)))
    before = {path: path.read_bytes() for path in tmp_path.glob("town*")}
    monkeypatch.setattr(np, "save", Mock(side_effect=OSError(errno.ENOSPC, "full")))
    (maps / "000.png").rename(maps / "100.png")
    code, _, (error,) = run(head, maps, "--save-descriptors", town)
    assert (code, error) == (2, f"run_onnx: {town}: No space left on device")
    assert {path: path.read_bytes() for path in tmp_path.glob("town*")} == before


def test_a_database_that_is_cut_off_between_its_files_is_refused(
    head, maps, town, run, monkeypatch
):
    """It would have the ids of one run, and the descriptors of another."""

    def flush(path):
        if path.name.startswith(".town.npy.fingerprint"):
            raise OSError(errno.EIO, "torn")

    (maps / "000.png").rename(maps / "100.png")
    with monkeypatch.context() as torn:
        torn.setattr("ssrvlad_torch.files.flush", flush)
        assert run(head, maps, "--save-descriptors", town)[0] == 2
    _, _, (error,) = run(head, maps, "--database", town)
    assert "town.npy.frames.txt does not exist" in error


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


def test_class_scores_are_read_from_arrays(maps, town, tmp_path, run):
    export_head(CONFIG, tmp_path / "head.onnx", input="logits")
    labels = np.asarray(Image.open(min(maps.iterdir())))
    np.save(tmp_path / "scores.npy", np.eye(12, dtype=np.float32)[labels].transpose(2, 0, 1))
    out = tmp_path / "out.npy"
    assert run(tmp_path / "head.onnx", tmp_path / "scores.npy", "--save-descriptors", out)[0] == 0
    assert run(tmp_path / "head.onnx", "--check")[0] == 0
    np.testing.assert_array_equal(np.load(out), np.load(town)[:1])
    code, _, errors = run(tmp_path / "head.onnx", maps)
    assert code == 3 and errors[0].endswith(
        "expected scores (C, H, W) in a .npy file, got another kind"
    )


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


# ---- what files say of themselves, and networks in them


def test_a_frame_of_more_than_the_file_can_count_is_skipped(head, tmp_path, run):
    np.save(tmp_path / "panorama.npy", np.zeros((120, 1000), np.uint8))
    code, out, errors = run(head, tmp_path / "panorama.npy")
    assert (code, out) == (3, "")
    assert "panorama.npy: the frame is too wide" in errors[0]


def test_the_golden_pair_holds_and_a_file_edited_does_not(head, tmp_path, run):
    code, out, _ = run(head, "--check")
    assert code == 0
    assert float(out.split()[-1]) <= 1e-6
    edit_golden(head, tmp_path / "edited.onnx", lambda g: g["unknown"].update(shape=[1, 2]))
    code, out, _ = run(tmp_path / "edited.onnx", "--check")
    assert code == 1 and out.startswith("largest difference for the golden pair: inf, unknown is")


def test_a_file_of_another_format_is_refused(head, maps, tmp_path, run, ssrvlad):
    old = without_property(head, tmp_path / "old.onnx", "format")
    for code, _, (line,) in (run(old, maps), ssrvlad("verify", old)):
        assert code == 2
        assert "old.onnx: a file of format 1; expected 2: export it again" in line


@pytest.mark.parametrize(
    ("others", "cosine", "problem"),
    [
        (0, 1, ""),
        (4, 0.99, ""),
        (20, 0.99, "2.0% of the pixels have another label"),
        (4, 0.5, "descriptors differ by 0.5"),
        (0, 0.99, "descriptors differ by 0.01"),
    ],
)
def test_where_few_labels_differ_the_descriptor_may(others, cosine, problem):
    golden = {"image": np.zeros((1, 50, 20, 3)), "labels": np.zeros((1, 50, 20), int)}
    golden |= {"descriptor": np.array([[1.0, 0]]), "unknown": np.zeros(1, int)}
    got = {**golden, "labels": golden["labels"].copy(), "descriptor": np.array([[cosine, 0]])}
    got["labels"].flat[:others] = 1
    runtime = SimpleNamespace(run=lambda names, inputs: [got[name] for name in names])
    metadata = SimpleNamespace(golden_arrays=lambda: {**golden})
    assert run_golden(runtime, "image", metadata).problem == problem


def test_a_file_of_fixed_size_takes_no_other(tmp_path, run):
    labels, path = street(0, *FIXED[1:]), tmp_path / "fixed.onnx"
    export_head(CONFIG, path, "labels", "int32", (), FIXED)
    got = Model(path).see_array(labels.astype(np.int32)).descriptor
    np.testing.assert_allclose(got, SSRVLAD(CONFIG)(labels[None])[0], rtol=0, atol=1e-6)
    np.save(tmp_path / "other.npy", labels[:-1])
    code, _, errors = run(path, tmp_path / "other.npy")
    assert code == 3
    assert f"takes labels of {FIXED}, got {(1, *labels[:-1].shape)}" in errors[0]


def test_a_photograph_needs_no_option(coloured, tmp_path, run):
    """It is turned upright, and normalised by the file."""
    place = coloured / "place.onnx"
    pixels = photo(street(3, 60, 90))
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    Image.fromarray(pixels[::-1, ::-1]).save(tmp_path / "a.png", exif=exif)
    np.save(tmp_path / "b.npy", pixels)
    expected = SSRVLAD(CONFIG)(street(3, 60, 90)[None]).numpy()
    out = tmp_path / "out.npy"
    frames = (tmp_path / "a.png", tmp_path / "b.npy")
    assert run(place, *frames, "--save-descriptors", out)[0] == 0
    np.testing.assert_allclose(np.load(out), expected.repeat(2, axis=0), atol=1e-6)
    assert run(place, "--check")[0] == 0
    Image.fromarray(street(3, 60, 90)).save(tmp_path / "map.png")
    code, _, err = run(place, tmp_path / "map.png")
    assert code == 3 and "expected a photograph, got a label map" in err[0]


@pytest.mark.parametrize("names", [("place",), ("net", "head")])
def test_a_picture_on_which_the_graph_fails_is_a_value_error(coloured, names):
    """ONNX Runtime raises errors of its own, here for bytes as floats."""
    model = (Model if len(names) == 1 else Split)(*(coloured / f"{name}.onnx" for name in names))
    refuses(r"the file fails at \(1, 6, 9, 3\): ", model.see_array, np.zeros((6, 9, 3), np.float32))


def test_network_and_head_in_two_files(coloured, tmp_path, run):
    """They give what one file gives; files that do not belong together are refused."""
    net, head, place = (coloured / f"{name}.onnx" for name in ("net", "head", "place"))
    pixels = photo(street(1, 60, 90))
    np.save(tmp_path / "1.npy", pixels)
    one, other = (model.see_array(pixels).descriptor for model in (Split(net, head), Model(place)))
    np.testing.assert_array_equal(one, other)
    code, out, _ = run(head, "--network", net, "--check")
    largest = out.removeprefix("largest difference for the golden pair: ")
    assert (code, float(largest) < 1e-6) == (0, True), out
    export_head(CONFIG, tmp_path / "wide.onnx", dtype="int64")
    paper = SSRVLADConfig.from_preset("paper", labels_as="camvid-11")
    export_head(paper, tmp_path / "paper.onnx")
    for wrong, message in (("wide", "takes labels tensor(int64)"), ("paper", "fingerprint")):
        code, _, (line,) = run(tmp_path / f"{wrong}.onnx", tmp_path / "1.npy", "--network", net)
        assert code == 2
        assert message in line


def test_channels_are_trusted_as_in_the_package():
    assert {channel.name: channel.trust for channel in (LabelShapes, HOG, Features)} == TRUST


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
