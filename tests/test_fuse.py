"""Fused files against the segmenter and the module run one after the other."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch
from drawings import SPACE, blobs
from exported import session
from helpers import refuses, street
from networks import (
    CLASSES,
    PLAIN,
    Street,
    Strided,
    colour_network,
    photo,
    shared_street,
    write_graph,
    write_street,
)
from onnx import TensorProto, helper, numpy_helper
from test_segmentation import GRAPHS
from torch import Tensor, nn

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.deployment.differences import difference_of, other_signs
from ssrvlad_torch.deployment.export import export_head
from ssrvlad_torch.deployment.fuse import NETWORK, fuse
from ssrvlad_torch.deployment.golden import outputs_of
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.deployment.runtimes import runtime_of
from ssrvlad_torch.deployment.verify import verify
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.stages.features import SHAPE

CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)
Images = npt.NDArray[Any]


def pictures(height: int = 133, width: int = 171, count: int = 2) -> Images:
    """``(B, H, W, 3)`` uint8."""
    return np.stack([photo(blobs(seed, height, width, 12)) for seed in range(count)])


run_of = cache(runtime_of().open)
"""A file as a function of its inputs by name, opened once."""


def assert_fused(
    segmenter: Segmenter, file: Path, images: Images, config: SSRVLADConfig = CONFIG
) -> None:
    """The labels, HOG and descriptors of a file are those of the segmenter, of `encode` and of the
    head."""
    outputs = run_of(file)({"image": images})
    labels, histograms = outputs.pop("labels"), outputs.pop("hog")
    outputs.pop("features", None)
    expected = HOG().describe([View("a/0", picture=picture) for picture in images])
    np.testing.assert_allclose(histograms, expected.numpy(), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(labels, segmenter(list(images)))
    expected = outputs_of(SSRVLAD(config), labels)
    assert outputs.keys() == expected.keys()
    assert not difference_of(outputs, expected)[1]
    assert outputs["descriptor"].any()
    assert not outputs["unknown"].any()


def assert_labelled(segmenter: Segmenter, file: Path, images: Images, others: float = 0) -> None:
    """All labels of a network's file but a fraction are those of the segmenter."""
    labels = run_of(file)({"image": images})["labels"]
    assert (labels != np.stack(segmenter(list(images)))).mean() <= others


OFTEN = ("dynamic", "labels inside", "external weights")
"""Each of the others is traced anew, and runs no code that these do not."""


@pytest.mark.parametrize(
    "form",
    [pytest.param(form, marks=[] if form in OFTEN else [pytest.mark.slow]) for form in GRAPHS],
)
def test_a_graph(form, tmp_path):
    network = OnnxNetwork(write_graph(tmp_path / "seg.onnx", **GRAPHS[form]))
    segmenter = Segmenter(network, SPACE, PLAIN)
    fuse(segmenter, CONFIG, tmp_path / "net.onnx", tmp_path / "head.onnx")
    assert_labelled(segmenter, tmp_path / "net.onnx", pictures(count=network.batch or 2))


OF_BYTES = {"white": 255, "mean": (73.2, 82.9, 72.4), "std": (1, 1, 1)}


@pytest.mark.parametrize(
    "settings",
    [
        {"size": 100, "longest": 120, "multiple": 16, "colour_order": "bgr", **OF_BYTES},
        pytest.param({"multiple": 8, **OF_BYTES}, marks=pytest.mark.slow),
    ],
)
def test_what_is_done_to_pictures_is_in_the_file(settings, tmp_path):
    segmenter = Segmenter(OnnxNetwork(write_graph(tmp_path / "seg.onnx")), SPACE, **settings)
    fuse(segmenter, CONFIG, tmp_path / "net.onnx", tmp_path / "head.onnx")
    for size in ((133, 171), (171, 133), (60, 300)):
        assert_labelled(segmenter, tmp_path / "net.onnx", pictures(*size), 1e-4)


@pytest.mark.parametrize("preset", ["default", pytest.param("paper", marks=pytest.mark.slow)])
def test_a_module(preset, tmp_path):
    class Scores(Strided):
        """More channels than classes, as from torchvision, at stride 4."""

        def forward(self, images: Tensor) -> dict[str, Tensor]:
            scores = super().forward(images)
            return {"out": torch.cat([scores, scores + 1], 1), "aux": -scores}

    segmenter = Segmenter(Scores(4), SPACE, PLAIN, classes=(0, CLASSES), output="out")
    config = SSRVLADConfig.from_preset(preset, labels_as=SPACE)
    fused = fuse(segmenter, config, tmp_path / "place.onnx")
    assert (fused.name, fused.settings["classes"]) == ("Scores", (0, CLASSES))
    for size in ((133, 171), (90, 64)):
        assert_fused(segmenter, tmp_path / "place.onnx", pictures(*size), config)
    assert verify(tmp_path / "place.onnx").passed


def test_a_users_own_export_of_paper_is_refused(tmp_path):
    head = SSRVLAD.from_preset("paper", labels_as=SPACE)
    whole = nn.Sequential(nn.Conv2d(3, CLASSES, 3, padding=1), head).eval()
    with pytest.raises(RuntimeError, match="expected export_head or ssrvlad fuse"):
        torch.onnx.export(whole, (torch.rand(2, 3, 66, 98),), tmp_path / "own.onnx", dynamo=True)


@pytest.mark.slow
def test_a_users_own_export_of_network_and_head_gives_the_descriptors_of_both(tmp_path):
    """At other sizes than the traced one. By default test_descriptor.py exports both for torch."""
    whole = nn.Sequential(colour_network(), SSRVLAD(CONFIG)).eval()
    dims = (dict.fromkeys((0, 2, 3), torch.export.Dim.AUTO),)
    example = (torch.rand(2, 3, 66, 98),)
    file = tmp_path / "own.onnx"
    torch.onnx.export(whole, example, file, dynamo=True, dynamic_shapes=dims, verbose=False)
    own = session(file)
    for size in ((66, 98), (133, 171), (171, 300)):
        images = torch.from_numpy(pictures(*size, count=3)).permute(0, 3, 1, 2) / 255
        (descriptor,) = own.run(None, {own.get_inputs()[0].name: images.numpy()})
        with torch.no_grad():
            np.testing.assert_allclose(descriptor, whole(images), rtol=0, atol=1e-6)
        assert descriptor.any()


def weighted(opset: int) -> onnx.ModelProto:
    """A convolution of random weights whose names are those of the head."""
    weight = np.random.default_rng(3).normal(size=(CLASSES, 3, 3, 3)).astype(np.float32)
    nodes = [
        helper.make_node("Conv", ["image", "table_0"], ["labels"], "thin", pads=[1] * 4),
        helper.make_node("Softmax", ["labels"], ["descriptor"], axis=1),
    ]
    value = [
        helper.make_tensor_value_info(each, TensorProto.FLOAT, ["B", count, "H", "W"])
        for each, count in (("image", 3), ("descriptor", CLASSES))
    ]
    tables = [numpy_helper.from_array(weight, "table_0")]
    graph = helper.make_graph(nodes, "network", value[:1], value[1:], tables)
    opsets = [helper.make_opsetid("", opset)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


@pytest.mark.parametrize("opset", [13, 21])
def test_any_opset_and_any_names(opset, tmp_path):
    onnx.save(weighted(opset), tmp_path / "seg.onnx")
    segmenter = Segmenter.load(tmp_path / "seg.onnx", SPACE)
    fuse(segmenter, CONFIG, tmp_path / "place.onnx")
    fused = onnx.load(tmp_path / "place.onnx")
    onnx.checker.check_model(fused)
    assert [each.version for each in fused.opset_import] == [max(18, opset)]
    assert_fused(segmenter, tmp_path / "place.onnx", pictures())


def test_what_cannot_be_fused_is_one_line_and_leaves_what_was_there(tmp_path):
    network, target = write_graph(tmp_path / "seg.onnx"), tmp_path / "place.onnx"
    target.write_text("before")
    export_head(CONFIG, tmp_path / "head.onnx", "logits")
    other, module = SSRVLADConfig(), Segmenter(Street(), SPACE, PLAIN)
    for source, config, message in (
        (network, other, "no output fits label space cityscapes-trainids"),
        (Segmenter.load(network, SPACE), other, "gives labels of camvid-11, the head reads citysc"),
        (tmp_path / "head.onnx", CONFIG, r"head\.onnx"),
        (module, CONFIG, r"Street: fails with 2 pictures of 66x98, .* multiple: "),
    ):
        refuses(message, fuse, source, config, target, features=False if source is module else None)
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        fuse(network, CONFIG, tmp_path / "none" / "place.onnx")
    assert target.read_text() == "before"
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["head.onnx", "place.onnx", "seg.onnx"]


RARE_FEATURES = [
    pytest.param(form, marks=pytest.mark.slow) for form in ("half", "module", "shared")
]


@pytest.mark.parametrize("form", ["graph", *RARE_FEATURES])
def test_features_are_those_of_the_segmenter(form, tmp_path):
    """Of one file, and of the first of two."""
    network = shared_street() if form == "shared" else Street()
    if form in ("graph", "half"):
        network = OnnxNetwork(write_street(tmp_path / "seg.onnx", half=form == "half"))
    segmenter = Segmenter(network, SPACE, PLAIN)
    paths = tmp_path / "place.onnx", tmp_path / "net.onnx", tmp_path / "head.onnx"
    fuse(segmenter, CONFIG, paths[0])
    if form == "graph":
        fuse(segmenter, CONFIG, *paths[1:])
        assert verify(paths[0]).passed and verify(paths[1]).passed
    for size in ((96, 128), (144, 304)):
        images = np.random.default_rng(0).integers(0, 256, (2, *size, 3), np.uint8)
        expected = np.stack([each.features for each in segmenter.segment([*images], True)])
        for file in paths[: 2 if form == "graph" else 1]:
            found = run_of(file)({"image": images})["features"]
            assert found.shape == expected.shape == (2, *SHAPE)
            assert other_signs(found, expected) < 1e-3


def test_a_file_without_features_and_networks_that_have_none(tmp_path):
    street, plain = write_street(tmp_path / "street.onnx"), write_graph(tmp_path / "plain.onnx")
    target = tmp_path / "place.onnx"
    assert fuse(plain, CONFIG, target).features == ""
    assert fuse(street, CONFIG, target, features=False).features == ""
    assert {"labels", "descriptor", "unknown", "hog"} == {
        value.name for value in onnx.load(target).graph.output
    }
    target.write_text("before")
    with pytest.raises(ValueError, match=r"plain\.onnx: .* no activation at a stride from 4 to 32"):
        fuse(plain, CONFIG, target, features=True)
    unknown = Segmenter(OnnxNetwork(street), SPACE, PLAIN, features=["nothing"])
    refuses(r"features: no activation 'nothing'; the nearest are", fuse, unknown, CONFIG, target)
    assert target.read_text() == "before"


def test_the_two_files_of_a_split_are_the_one(tmp_path, ssrvlad):
    """The network and the head apart give what they give together. The one says what it holds, and
    the command what it assumes of pictures."""
    network = write_graph(tmp_path / "seg.onnx")
    both = [tmp_path / name for name in ("net.onnx", "head.onnx")]
    command = ("fuse", network, "-o", both[0], "--split", both[1], "--labels-as", SPACE)
    code, _, err = ssrvlad(*command)
    assert code == 0 and "seg.onnx does not say how it wants pictures; assumed: rgb" in err[0]
    fuse(network, CONFIG, tmp_path / "place.onnx")
    properties = session(tmp_path / "place.onnx").get_modelmeta().custom_metadata_map
    metadata, said = Metadata.from_properties(properties), json.loads(properties[NETWORK])
    assert metadata.fingerprint == CONFIG.fingerprint
    assert metadata.interface["inputs"]["image"] == {"dtype": "uint8", "shape": ["B", "H", "W", 3]}
    assert set(metadata.golden) == {"image", "labels", "descriptor", "unknown", "hog"}
    assert (said["name"], said["key"]) == ("seg.onnx", Segmenter.load(network, SPACE).key())
    image = photo(street(3, 60, 90))[None]
    expected = run_of(tmp_path / "place.onnx")({"image": image})
    labels = run_of(both[0])({"image": image})
    assert labels.keys() == {"labels", "hog"}
    got = run_of(both[1])({"labels": labels["labels"]})
    for name, array in {**labels, **got}.items():
        np.testing.assert_array_equal(array, expected[name])
    for file in both:
        assert verify(file).passed
    assert [check.name for check in verify(both[0]).checks] == ["golden image"]
