"""Files of `ssrvlad export` and `ssrvlad fuse` without torch, through `run_onnx.py`."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import run_onnx
import torch
from exported import edit_golden, turned, without_property
from helpers import street
from networks import PLAIN, photo, write_graph
from PIL import Image
from ssrvlad_place.golden import run_golden
from ssrvlad_place.model import TRUST, Model, Split

from ssrvlad_torch import SSRVLAD, SSRVLADConfig, export_head
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.deployment.fuse import fuse
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter

CONFIG = SSRVLADConfig(labels_as="camvid-11")


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
    return partial(main_of, run_onnx.main, "run_onnx.py")


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


def test_a_runtime_that_gets_the_golden_pair_wrong_is_refused(head, maps, fused, tmp_path, run):
    wrong = edit_golden(head, tmp_path / "wrong.onnx", turned("labels"))
    code, out, (line,) = run(wrong, maps)
    assert (code, out) == (2, "")
    assert "wrong.onnx is computed wrong here (largest difference for the golden pair: " in line
    assert run(wrong, maps, "--unchecked")[:2] == run(head, maps)[:2]
    edit_golden(fused[0] / "net.onnx", wrong, turned("image"))
    np.save(tmp_path / "a.npy", photo(street(3, 60, 90)))
    code, _, (line,) = run(fused[0] / "head.onnx", tmp_path / "a.npy", "--network", wrong)
    assert code == 2 and "wrong.onnx is computed wrong here" in line
    assert "% of the pixels have another label" in line


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda golden: golden["labels"].update(shape=[1 << 20, 1 << 20]), "at most 64 MiB"),
        (lambda golden: golden.pop("labels"), "no golden pair for input labels"),
        (lambda golden: golden.pop("descriptor"), "no golden pair for input labels"),
        (lambda golden: golden["labels"].update(data="AAAA"), "run_onnx: "),
    ],
)
def test_a_damaged_golden_pair_is_one_line(head, maps, tmp_path, run, change, message):
    code, _, (line,) = run(edit_golden(head, tmp_path / "x.onnx", change), maps)
    assert code == 2
    assert message in line


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


def test_a_file_of_fixed_size_takes_no_other(maps, tmp_path, run):
    files = sorted(maps.iterdir())
    labels = np.asarray(Image.open(files[0]))
    shape, path = (1, *labels.shape), tmp_path / "fixed.onnx"
    export_head(CONFIG, path, "labels", "int32", (), shape)
    got = Model(path).see_array(labels.astype(np.int32)).descriptor
    np.testing.assert_allclose(got, SSRVLAD(CONFIG)(labels[None])[0], rtol=0, atol=1e-6)
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


def test_network_and_head_in_two_files(fused, tmp_path, run):
    """They give what one file gives; files that do not belong together are refused."""
    net, head, place = (fused[0] / f"{name}.onnx" for name in ("net", "head", "place"))
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
