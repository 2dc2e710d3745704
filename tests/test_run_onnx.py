"""The script without torch against the command line."""

import importlib.util
import json
import shutil
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from drives import write_maps
from graphs import edit_golden, turned
from helpers import (
    COLOUR,
    GRAY,
    PALETTES,
    flip_byte,
    street,
    without,
    write_palette,
    write_png,
)
from networks import PLAIN, colour_network, photo, write_graph
from onnx import TensorProto, helper
from PIL import Image
from segmenting import write_drives
from torch import nn

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter

SCRIPT = Path(__file__).parents[1] / "export" / "run_onnx.py"
CONFIG = SSRVLADConfig(labels_as="camvid-11", working_size=40)


def load_script():
    spec = importlib.util.spec_from_file_location("run_onnx", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


script = load_script()


def alone(*arguments, blocked=("torch", "ssrvlad_torch")):
    """Runs the script in a new process that cannot import the blocked modules."""
    command = without(blocked, SCRIPT, *arguments)
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    path = tmp_path_factory.mktemp("heads") / "head.onnx"
    export_head(CONFIG, path)
    return path


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """A network and the head in one file, ``place.onnx``, and in two, ``net.onnx`` and
    ``head.onnx``; and the network as a segmenter. Not to be changed."""
    folder = tmp_path_factory.mktemp("fused")
    segmenter = Segmenter(OnnxNetwork(write_graph(folder / "seg.onnx")), CONFIG.labels_as, PLAIN)
    fuse(segmenter, CONFIG, folder / "place.onnx")
    fuse(segmenter, CONFIG, folder / "net.onnx", folder / "head.onnx")
    return folder, segmenter


@pytest.fixture
def run(main_of):
    return partial(main_of, script.main, "run_onnx.py")


@pytest.fixture
def town(head, maps, tmp_path, run):
    """A database that the script wrote."""
    assert run(head, maps, "--save-descriptors", tmp_path / "town.npy")[0] == 0
    return tmp_path / "town.npy"


SINGLE = ("--no-standardise", "--no-sweep", "--follow", "no")


def test_without_torch_it_finds_what_the_command_line_finds(ssrvlad, database, maps, tmp_path):
    export_head(SSRVLADConfig(labels_as="camvid-11"), tmp_path / "head.onnx")
    queries = write_maps(tmp_path / "tuesday", range(4, 9))
    assert ssrvlad("db", "export", database, "--format", "npy", "-o", tmp_path / "t.npy")[0] == 0
    expected_lines = ssrvlad("query", database, queries, *SINGLE, "--top", 3, "--json")[1]
    arguments = (queries, "--database", tmp_path / "t.npy", "--top", 3, "--json")
    ran = alone(tmp_path / "head.onnx", *arguments)
    assert ran.returncode == 0, ran.stderr
    lines = zip(expected_lines.splitlines(), ran.stdout.splitlines(), strict=True)
    for expected, found in (map(json.loads, pair) for pair in lines):
        assert found["query"] == expected["query"]
        pairs = zip(found["candidates"], expected["candidates"], strict=True)
        for candidate, other in pairs:
            assert candidate["frame"] == other["frame"]
            assert candidate["score"] == pytest.approx(other["score"], abs=1e-5)


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A network with features as ``net.yaml``, photos in ``monday`` and ``today``, and the fused
    files: ``place.onnx``, or ``net.onnx`` and ``head.onnx``. Not to be changed."""
    return write_drives(tmp_path_factory.mktemp("drives"))


def test_with_features_it_finds_what_the_command_line_finds(drives, ssrvlad, tmp_path, run):
    """In a database of the command line and in its own, with one file and with two."""
    given = ("--segmenter", drives / "net.yaml", "--extra", "features", "--workers", 1)
    for drive in ("monday", "today"):
        assert ssrvlad("encode", drives / drive, "-o", tmp_path / drive, *given)[0] == 0
    alone = ("--no-standardise", "--follow", "no", "--top", 12, "--json")
    out = ssrvlad("query", tmp_path / "monday", tmp_path / "today", *alone)[1]
    expected = [json.loads(line) for line in out.splitlines()]
    assert expected[0]["score_is"] == "fused score"
    town = tmp_path / "town.npy"
    assert ssrvlad("db", "export", tmp_path / "monday", "--format", "npy", "-o", town)[0] == 0
    own = tmp_path / "own.npy"
    assert run(drives / "place.onnx", drives / "monday", "--save-descriptors", own)[0] == 0
    np.testing.assert_array_equal(*(np.load(f"{each}.features.npy") for each in (town, own)))
    two = ("--network", drives / "net.onnx")
    for model, database, network in (("place", town, ()), ("head", own, two)):
        arguments = (drives / "today", "--database", database, "--top", 12, "--json", *network)
        code, out, err = run(drives / f"{model}.onnx", *arguments)
        assert (code, err) == (0, [])
        for line, right in zip(out.splitlines(), expected, strict=True):
            found = json.loads(line)["candidates"]
            pairs = list(zip(found, right["candidates"], strict=True))
            assert [a["frame"] for a, _ in pairs] == [b["frame"] for _, b in pairs]
            np.testing.assert_allclose(
                *([e["score"] for e in each] for each in zip(*pairs, strict=True)),
                rtol=0,
                atol=1e-5,
            )


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
    assert line == "only the model has features: frames are matched by their label maps alone"


def test_activations_that_say_nothing_are_refused(drives, tmp_path, run):
    """An image of one colour, of which an exported file gives no sign."""
    model = onnx.load(drives / "place.onnx")
    for table in model.graph.initializer:
        if table.name.startswith("network/") and table.data_type == TensorProto.FLOAT:
            table.CopyFrom(
                onnx.numpy_helper.from_array(0 * onnx.numpy_helper.to_array(table), table.name)
            )
    onnx.save(model, tmp_path / "dead.onnx")
    code, _, errors = run(tmp_path / "dead.onnx", drives / "today" / "5.png", "--unchecked")
    assert code == 3
    assert errors[0].endswith("activations of the network are not finite, or the same everywhere")
    code, _, (line,) = run(tmp_path / "dead.onnx", drives / "today" / "5.png")
    assert code == 2 and "% of the features differ" in line


def test_arrays_need_no_pillow_and_pictures_say_so(head, maps, tmp_path):
    labels = np.asarray(Image.open(next(iter(sorted(maps.iterdir())))))
    np.save(tmp_path / "map.npy", labels)
    blocked = ("torch", "ssrvlad_torch", "PIL")
    assert alone(head, tmp_path / "map.npy", blocked=blocked).returncode == 0
    refused = alone(head, maps, blocked=blocked)
    assert refused.returncode == 2
    assert refused.stderr.splitlines()[-1].endswith("pip install pillow; or give .npy arrays")


def test_descriptors_are_those_of_the_module(head, maps, town):
    files = sorted(maps.iterdir())
    labels = np.stack([np.asarray(Image.open(file)) for file in files])
    np.testing.assert_allclose(np.load(town), SSRVLAD(CONFIG)(labels).numpy(), atol=1e-6)
    names = [f"{file.parent.name}/{file.stem}" for file in files]
    assert Path(f"{town}.frames.txt").read_text().splitlines() == names
    assert Path(f"{town}.fingerprint.txt").read_text().strip() == CONFIG.fingerprint


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


def test_a_frame_of_more_than_the_file_can_count_is_skipped(tmp_path, run):
    export_head(SSRVLADConfig(labels_as="camvid-11"), tmp_path / "default.onnx")
    np.save(tmp_path / "panorama.npy", np.zeros((120, 1000), np.uint8))
    code, out, errors = run(tmp_path / "default.onnx", tmp_path / "panorama.npy")
    assert (code, out) == (3, "")
    assert "panorama.npy: the frame is too wide" in errors[0]


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


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.full((5, 6), -1), "30 of 30 pixels have an id outside uint8"),
        (np.full((5, 6), 256), "30 of 30 pixels have an id outside uint8"),
        (np.zeros((5, 6), np.float32), "expected an (H, W) label map, got (5, 6) float32"),
        (np.zeros((2, 5, 6), int), "expected an (H, W) label map, got (2, 5, 6) int64"),
        (np.zeros((0, 6), int), "expected an (H, W) label map, got (0, 6) int64"),
    ],
)
def test_arrays_that_are_no_label_map(head, tmp_path, run, labels, message):
    np.save(tmp_path / "map.npy", labels)
    code, _, errors = run(head, tmp_path / "map.npy")
    assert (code, errors[0]) == (3, f"{tmp_path / 'map.npy'}: {message}")


def test_pictures_that_are_no_label_map(head, tmp_path, run):
    write_png(tmp_path / "a.png", np.zeros((5, 6, 3), int), COLOUR, 8)
    write_png(tmp_path / "b.png", np.zeros((5, 6), int), GRAY, 4)
    write_png(tmp_path / "c.png", np.zeros((5, 6), int), GRAY, 16)
    (tmp_path / "d.png").write_bytes((tmp_path / "c.png").read_bytes()[:40])
    code, out, errors = run(head, tmp_path / "a.png", *(tmp_path / f"{n}.png" for n in "bcd"))
    assert (code, len(out.splitlines()), errors[-1]) == (3, 1, "skipped 3 of 4 frames")
    assert "got RGB" in errors[0]
    assert "got L L;4" in errors[1]


@pytest.mark.parametrize(("pixels", "colours", "ids"), PALETTES.values(), ids=PALETTES)
def test_a_palette_is_read_as_by_encode(head, tmp_path, run, pixels, colours, ids):
    write_palette(tmp_path / "a.png", pixels, colours)
    np.save(tmp_path / "b.npy", np.array([ids if isinstance(ids, list) else pixels]))
    code, _, errors = run(head, tmp_path, "--save-descriptors", tmp_path / "o.npy")
    if isinstance(ids, list):
        one, other = np.load(tmp_path / "o.npy")
        assert one.any()
        np.testing.assert_array_equal(one, other)
    else:
        assert code == 3
        assert f"the palette shows index {ids} as " in errors[0]


def test_an_id_of_several_lines_is_refused_where_ids_are_lines(head, maps, tmp_path, run):
    """A database must be read back as it was written."""
    folder = tmp_path / "day"
    folder.mkdir()
    shutil.copy(sorted(maps.iterdir())[0], folder / "a\nb.png")
    out = tmp_path / "town.npy"
    code, _, errors = run(head, folder, "--save-descriptors", out)
    assert (code, len(errors), out.exists()) == (2, 1, False)
    assert "a database has one id a line; frame 'day/a\\nb' has several" in errors[0]
    assert run(head, folder)[0] == 0
    with pytest.raises(ValueError, match="has several lines"):
        script.save(out, [script.Seen(np.ones(3))], ["a\x85b"], "")
    assert not list(tmp_path.glob("town*"))


def test_an_empty_frame_matches_nothing_and_is_no_candidate(head, maps, tmp_path, run):
    Image.fromarray(np.full((9, 9), 11, np.uint8)).save(maps / "void.png")
    out = tmp_path / "out.npy"
    assert run(head, maps, "--save-descriptors", out)[0] == 0
    lines = [
        json.loads(line)
        for line in run(head, maps, "--database", out, "--top", 9, "--json")[1].splitlines()
    ]
    assert {line["query"]: line["empty"] for line in lines}["monday/void"]
    assert all(len(line["candidates"]) == (0 if line["empty"] else 6) for line in lines)


def test_equal_scores_go_to_the_earlier_frame_across_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(script, "_BLOCK", 3)
    rng = np.random.default_rng(0)
    vectors = rng.integers(-1, 2, (20, 4)).astype(np.float32)
    frames = [f"s/{row}" for row in range(20)]
    script.save(tmp_path / "d.npy", list(map(script.Seen, vectors)), frames, "f")
    database = script.Database(tmp_path / "d.npy", "f")
    query = np.array([1, 0, 0, 0], np.float32)
    scores = {}
    for frame, vector in zip(frames, vectors, strict=True):
        if vector.any():
            scores[frame] = vector[0] / np.linalg.norm(vector)
    best = sorted(scores, key=lambda frame: -scores[frame])[:7]
    assert [frame for frame, _ in database.search(query, 7)] == best


def test_the_golden_pair_holds_and_a_file_edited_does_not(head, tmp_path, run):
    code, out, _ = run(head, "--check")
    assert code == 0
    assert float(out.split()[-1]) <= 1e-6
    edit_golden(head, tmp_path / "edited.onnx", lambda g: g["unknown"].update(shape=[1, 2]))
    assert run(tmp_path / "edited.onnx", "--check")[:2] == (
        1,
        "largest difference for the golden pair: inf\n",
    )


def test_a_file_of_another_format_is_refused(head, maps, tmp_path, run, ssrvlad):
    model = onnx.load(head)
    (written,) = (entry for entry in model.metadata_props if entry.key == "ssrvlad.format")
    model.metadata_props.remove(written)
    onnx.save(model, tmp_path / "old.onnx")
    message = "old.onnx: a file of format 1; expected 2: export it again"
    for code, _, (line,) in (
        run(tmp_path / "old.onnx", maps),
        ssrvlad("verify", tmp_path / "old.onnx"),
    ):
        assert code == 2
        assert message in line


def test_a_runtime_that_gets_the_golden_pair_wrong_is_refused(head, maps, tmp_path, run):
    wrong = edit_golden(head, tmp_path / "wrong.onnx", turned("labels"))
    code, out, (line,) = run(wrong, maps)
    assert (code, out) == (2, "")
    assert "wrong.onnx is computed wrong here (largest difference for the golden pair: " in line
    assert run(wrong, maps, "--unchecked")[:2] == run(head, maps)[:2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda golden: golden["labels"].update(shape=[1 << 20, 1 << 20]), "at most 64 MiB"),
        (lambda golden: golden.pop("labels"), "no golden pair for input labels"),
        (lambda golden: golden["labels"].update(data="AAAA"), "run_onnx: "),
    ],
)
def test_a_damaged_golden_pair_is_one_line(head, maps, tmp_path, run, change, message):
    code, _, (line,) = run(edit_golden(head, tmp_path / "x.onnx", change), maps)
    assert code == 2
    assert message in line


def test_when_a_golden_pair_holds():
    golden = script.Golden
    assert golden(1e-7).holds
    assert not golden(1e-5).holds
    assert not golden(float("nan")).holds
    assert golden(0.02, other_pixels=0.004, cosine=0.99).holds
    assert not golden(0.02, other_pixels=0.02, cosine=0.99).holds
    assert not golden(0.02, other_pixels=0.004, cosine=0.5).holds
    assert golden(0, other_signs=0.009).holds
    assert not golden(0, other_signs=0.011).holds


def test_an_unknown_provider_is_named(head, maps, run):
    code, _, (line,) = run(head, maps, "--provider", "Abacus")
    assert code == 2
    assert line.startswith("run_onnx: no provider Abacus; expected one of ")


def test_class_scores_and_wide_labels(maps, tmp_path, run):
    file = sorted(maps.iterdir())[0]
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
    message = "expected scores (C, H, W) in a .npy file, got another kind of file"
    assert (code, errors[0]) == (3, f"{file}: {message}")
    shutil.copy(file, tmp_path / "picture.npy")
    errors = run(tmp_path / "head.onnx", tmp_path / "picture.npy")[2]
    assert errors[0].endswith(
        "picture.npy: expected an array in a .npy file, got another kind of file"
    )


def test_a_file_of_fixed_size_takes_no_other(maps, tmp_path, run):
    files = sorted(maps.iterdir())
    labels = np.asarray(Image.open(files[0]))
    shape, path = (1, *labels.shape), tmp_path / "fixed.onnx"
    config = SSRVLADConfig(labels_as="camvid-11")
    export_head(config, path, "labels", "int32", (), shape)
    got = script.Model(path).describe(files[0])
    np.testing.assert_allclose(got, SSRVLAD(config)(labels[None])[0], rtol=0, atol=1e-6)
    np.save(tmp_path / "other.npy", labels[:-1])
    code, _, errors = run(path, tmp_path / "other.npy")
    assert code == 3
    assert f"takes labels of {shape}, got {(1, *labels[:-1].shape)}" in errors[0]


def test_a_photograph_needs_no_option(fused, tmp_path, run):
    """It is turned upright, and normalised by the file."""
    place, segmenter = fused[0] / "place.onnx", fused[1]
    pixels = photo(street(3, 60, 90))
    exif = Image.Exif()
    exif[0x0112] = 3  # upside down
    Image.fromarray(pixels[::-1, ::-1]).save(tmp_path / "a.png", exif=exif)
    np.save(tmp_path / "b.npy", pixels)
    expected = SSRVLAD(CONFIG)(torch.from_numpy(segmenter([pixels])[0])[None]).numpy()
    out = tmp_path / "out.npy"
    frames = (tmp_path / "a.png", tmp_path / "b.npy")
    assert run(place, *frames, "--save-descriptors", out)[0] == 0
    np.testing.assert_allclose(np.load(out), expected.repeat(2, axis=0), atol=1e-6)
    assert run(place, "--check")[0] == 0
    Image.fromarray(street(3, 60, 90)).save(tmp_path / "map.png")
    code, _, err = run(place, tmp_path / "map.png")
    assert code == 3 and "expected a photograph, got a label map" in err[0]


class Ids(nn.Module):
    """A network that gives ids, and to one colour one that no label space has."""

    def __init__(self) -> None:
        super().__init__()
        self.network = colour_network()

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        strange = (images[:, 0] * 255).round() == 254
        return torch.where(strange, 300, self.network(images).argmax(1))


def test_unknown_ids_of_a_network_are_counted_and_skipped(tmp_path, run):
    fuse(Segmenter(Ids(), CONFIG.labels_as, PLAIN), CONFIG, tmp_path / "place.onnx")
    pixels = photo(street(3, 60, 90))
    np.save(tmp_path / "plain.npy", pixels)
    pixels[7, :11] = 254, 0, 0
    np.save(tmp_path / "strange.npy", pixels)
    frames = (tmp_path / "plain.npy", tmp_path / "strange.npy")
    code, out, err = run(tmp_path / "place.onnx", *frames)
    assert (code, out.count("\n"), "plain" in out) == (3, 1, True)
    assert err[0].endswith("11 of 5400 pixels have an id outside label space camvid-11")


def test_wrong_use_is_one_line(head, maps, town, tmp_path, run):
    other = tmp_path / "other.onnx"
    node = helper.make_node("Identity", ["x"], ["y"])
    forms = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in "xy"]
    graph = helper.make_graph([node], "g", forms[:1], forms[1:])
    opset = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), other)
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(head.read_bytes()[:1000])
    damaged = tmp_path / "damaged.npy"
    damaged.write_bytes(town.read_bytes())
    Path(f"{damaged}.frames.txt").write_text("a/1\n")
    flip_byte(damaged, 0)
    for arguments, message in [
        ((tmp_path / "none.onnx", maps), "No such file"),
        ((other, maps), "no metadata ssrvlad.*"),
        ((cut, maps), str(cut)),
        ((head, tmp_path / "nowhere"), "holds no frames"),
        ((head, maps, "--database", damaged), "expected an array in a .npy file"),
        ((head, maps, "--database", head), f"{head}: expected an array in a .npy file"),
        ((head, maps, maps), "is a second frame monday/"),
    ]:
        code, _, errors = run(*arguments)
        assert code == 2, arguments
        assert len(errors) == 1, errors
        assert message in errors[0]
    Path(f"{town}.frames.txt").write_text("a/1\n")
    assert run(head, maps, "--database", town)[2][0].endswith("for 1 frames")
    assert run(head)[0] == run(head, maps, "--check")[0] == run(head, maps, "--top", 0)[0] == 2


def test_of_a_sweep_the_best_anchor_counts(tmp_path, run):
    """Each reference is the descriptor of one anchor of the query."""
    labels = np.random.default_rng(0).integers(0, 11, (6, 9)).repeat(20, 0).repeat(20, 1)
    np.save(tmp_path / "query.npy", labels.astype(np.uint8))
    config = SSRVLADConfig(labels_as="camvid-11")
    export_head(config, tmp_path / "sweep.onnx", columns=(-8, 0, 8))
    model = script.Model(tmp_path / "sweep.onnx")
    swept = model.describe(tmp_path / "query.npy")
    seen, names = list(map(script.Seen, swept)), ["left", "middle", "right"]
    script.save(tmp_path / "town.npy", seen, names, model.fingerprint)
    source = (tmp_path / "sweep.onnx", tmp_path / "query.npy")
    code, out, _ = run(*source, "--database", tmp_path / "town.npy", "--top", 3)
    assert (code, out.count("1.0000")) == (0, 3)
    code, _, err = run(*source, "--save-descriptors", tmp_path / "no.npy")
    assert (code, "expected a file without --sweep" in err[0]) == (2, True)


def test_network_and_head_in_two_files(fused, tmp_path, run):
    """They give what one file gives; files that do not belong together are refused."""
    net, head, place = (fused[0] / f"{name}.onnx" for name in ("net", "head", "place"))
    pixels = np.stack([photo(street(seed, 60, 90)) for seed in range(2)])
    for number, image in enumerate(pixels):
        np.save(tmp_path / f"{number}.npy", image)
    frames = [tmp_path / "0.npy", tmp_path / "1.npy"]
    assert run(head, *frames, "--network", net) == run(place, *frames)
    assert run(head, *frames, "--network", net)[0] == 0
    one, other = (script.Split(net, head), script.Model(place))
    for frame in frames:
        np.testing.assert_array_equal(one.describe(frame), other.describe(frame))
    code, out, _ = run(head, "--network", net, "--check")
    largest = out.removeprefix("largest difference for the golden pair: ")
    assert (code, float(largest) < 1e-6) == (0, True), out
    export_head(CONFIG, tmp_path / "wide.onnx", dtype="int64")
    export_head(SSRVLADConfig(labels_as="camvid-11"), tmp_path / "default.onnx")
    for wrong, message in (("wide", "takes labels tensor(int64)"), ("default", "fingerprint")):
        code, _, (line,) = run(tmp_path / f"{wrong}.onnx", *frames, "--network", net)
        assert code == 2
        assert message in line


def test_a_network_that_labels_otherwise_is_refused(fused, tmp_path, run):
    model = onnx.load(fused[0] / "net.onnx")
    (bias,) = (t for t in model.graph.initializer if t.name == "network/bias")
    bias.CopyFrom(
        onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(bias)[::-1].copy(), bias.name)
    )
    onnx.save(model, tmp_path / "net.onnx")
    np.save(tmp_path / "a.npy", photo(street(3, 60, 90)))
    code, _, (line,) = run(
        fused[0] / "head.onnx", tmp_path / "a.npy", "--network", tmp_path / "net.onnx"
    )
    assert code == 2
    assert "net.onnx is computed wrong here" in line
    assert "% of the labels differ" in line
