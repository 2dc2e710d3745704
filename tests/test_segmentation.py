"""From images to descriptors, by a module or an ONNX graph; label spaces of class names."""

import dataclasses
import sys

import numpy as np
import onnx
import pytest
import yaml
from drawings import SPACE
from helpers import refuses
from networks import (
    LABELS,
    PHOTOS,
    PLAIN,
    assert_right,
    colour_network,
    write_graph,
    write_street,
)
from torch import nn

from ssrvlad_torch.segmentation.class_names import category_of_name, label_space_of_names
from ssrvlad_torch.segmentation.onnx_files import external_files
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.taxonomy import VOID, label_space, label_space_names


def test_settings_are_keyword_arguments(tmp_path):
    """They are those of a YAML file, by the same names and in the same forms."""
    keywords = {"size": [24, 32], "mean": [0, 0, 0], "std": [1, 1, 1], "colour_order": "bgr",
             "classes": "0:12"}  # fmt: skip
    segmenter = Segmenter(colour_network(), SPACE, **keywords)
    write_graph(tmp_path / "net.onnx")
    (tmp_path / "net.yaml").write_text(yaml.safe_dump({"network": "net.onnx", **keywords}))
    by_file = Segmenter.load(tmp_path / "net.yaml", SPACE)
    assert segmenter.config == by_file.config
    assert segmenter.config.classes == (0, 12)
    one = PHOTOS[:1]
    np.testing.assert_array_equal(segmenter(one), by_file(one))
    other = Segmenter(segmenter.network, SPACE, segmenter.config, colour_order="rgb")
    assert other.config == dataclasses.replace(segmenter.config, colour_order="rgb")
    np.testing.assert_array_equal(other(one), LABELS[:1])
    with pytest.raises(ValueError, match="unknown setting 'means'; expected size, longest, mult"):
        Segmenter(colour_network(), SPACE, means=(0, 0, 0))


@pytest.mark.parametrize(
    ("graph", "settings", "message"),
    [
        ({"dtype": "bytes"}, {}, "takes bytes: expected white 255, got 1"),
        ({"shape": (1, 3, 24, 32)}, {"size": (32, 32)}, "takes .* 24x32, the settings say 32x32"),
        ({"shape": (1, 3, 24, "w")}, {}, "takes images of 24xany; expected a size"),
    ],
)
def test_a_graph_that_does_not_fit_the_settings_is_refused(tmp_path, graph, settings, message):
    network = OnnxNetwork(write_graph(tmp_path / "net.onnx", **graph))
    refuses(rf"net\.onnx: {message}", Segmenter, network, SPACE, **settings)


@pytest.mark.parametrize(
    ("graph", "space", "message"),
    [
        ({"aux": True}, SPACE, r"several outputs could be labels: found \(1, 12, 24, 32\) float32"),
        ({}, "cityscapes-trainids", "no output fits .*cityscapes-trainids.* = 19"),
    ],
)
def test_a_graph_whose_outputs_do_not_fit_is_refused(tmp_path, graph, space, message):
    network = OnnxNetwork(write_graph(tmp_path / "net.onnx", **graph))
    refuses(message, Segmenter(network, space), PHOTOS[:1])


def test_the_network_is_in_evaluation_mode_and_takes_no_gradients():
    network = nn.Sequential(colour_network(), nn.Dropout(0.9))
    network[0].weight.requires_grad_(True)
    assert_right(Segmenter(network.train(), SPACE, PLAIN))
    assert not network.training


@pytest.mark.parametrize("damage", ["text", "truncated", "weights gone", "missing"])
def test_a_damaged_graph_is_an_error_in_one_line(tmp_path, damage, capfd):
    path = write_graph(tmp_path / "net.onnx", external=damage == "weights gone")
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "weights gone":
        (tmp_path / "net.data").unlink()
    else:
        path.write_bytes({"text": b"hello", "truncated": whole[:-40]}[damage])
    apart = "the file and that of its weights belong together" if damage == "weights gone" else ""
    refuses(rf"net\.onnx (does not exist|cannot run).*{apart}", OnnxNetwork, path)
    assert capfd.readouterr() == ("", ""), "the runtime keeps its log to itself"


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    path = write_graph(tmp_path / "net.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install ssrvlad-torch\[onnx\]"):
        Segmenter.load(path, SPACE)


@pytest.mark.parametrize("external", [False, True])
def test_a_graph_is_known_by_its_file_and_its_weights(tmp_path, external):
    def key(white):
        path = write_graph(tmp_path / "net.onnx", external=external, white=white)
        return Segmenter(OnnxNetwork(path), SPACE, PLAIN).key()

    first, second, third = key(1.0), key(1.5), key(1.0)
    assert first == third != second
    assert external_files(tmp_path / "net.onnx") == [tmp_path / "net.data"] * external


GRAPHS = {
    "dynamic": {},
    "all fixed": {"shape": (1, 3, 24, 32)},
    "a batch of three": {"shape": (3, 3, 24, 32)},
    "channels free": {"shape": ("b", "c", "h", "w")},
    "labels inside": {"labels": True},
    "labels without a batch": {"shape": (1, 3, 24, 32), "labels": True, "alone": True},
    "quantised": {"quantised": True},
    "external weights": {"external": True},
    "half input": {"dtype": "half"},
    "double input": {"dtype": "double"},
    "channels last": {"shape": ("b", "h", "w", 3), "channels_last": True},
    "channels last, labels inside": {
        "shape": (1, 24, 32, 3),
        "channels_last": True,
        "labels": True,
    },
}


@pytest.mark.parametrize("form", GRAPHS)
def test_a_graph_gives_what_the_network_gives(tmp_path, form):
    path = write_graph(tmp_path / "net.onnx", **GRAPHS[form])
    assert_right(Segmenter(OnnxNetwork(path), SPACE, PLAIN))


def test_a_graph_takes_bytes(tmp_path):
    shape, settings = (1, 24, 32, 3), SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1))
    path = write_graph(tmp_path / "net.onnx", shape, "bytes", channels_last=True, white=255)
    assert_right(Segmenter(OnnxNetwork(path), SPACE, settings))


def test_a_file_that_has_changed_since_is_not_taken_for_the_graph(tmp_path):
    """Its features would be stored as those of the graph."""
    path = write_graph(tmp_path / "net.onnx")
    segmenter = Segmenter(OnnxNetwork(path), SPACE, PLAIN)
    write_street(path)
    refuses(r"net\.onnx has changed or is", lambda: segmenter.features)


def graph_of(inputs, path):
    """A graph that only passes on its inputs."""
    nodes = [onnx.helper.make_node("Identity", [one.name], [f"{one.name}2"]) for one in inputs]
    outputs = [
        onnx.helper.make_tensor_value_info(f"{one.name}2", one.type.tensor_type.elem_type, None)
        for one in inputs
    ]
    graph = onnx.helper.make_graph(nodes, "none", inputs, outputs)
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), path)
    return path


def value(name, shape, dtype=onnx.TensorProto.FLOAT):
    return onnx.helper.make_tensor_value_info(name, dtype, shape)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ([value("a", [1, 3, 4, 4]), value("b", [1])], "has inputs a, b; expected one"),
        ([value("a", [1, 3, 4])], r"takes \(1, 3, 4\) tensor\(float\); expected \(B, 3, H, W\)"),
        ([value("a", [1, 1, 4, 4])], r"takes \(1, 1, 4, 4\) .*; expected images of 3 channels"),
        ([value("a", [1, 3, 4, 4], onnx.TensorProto.INT64)], r"tensor\(int64\); expected"),
    ],
)
def test_a_graph_that_takes_no_image_is_refused(tmp_path, inputs, message):
    refuses(message, OnnxNetwork, graph_of(inputs, tmp_path / "net.onnx"))


BY_CHOICE = {"Bridge", "Tunnel", "license plate", "lamp"}
"""Where a label space differs from the others, or from itself."""


@pytest.mark.parametrize("name", label_space_names())
def test_names_mean_what_the_label_spaces_say(name):
    for label in label_space(name).classes:
        if label.name not in BY_CHOICE:
            assert (category_of_name(label.name) or VOID) == label.category, label.name


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("building, edifice", "building"),  # ADE20K
        ("streetlight, street lamp", "pole"),
        ("wall-brick", "building"),  # COCO-Stuff
        ("sky-other-merged", "sky"),
        ("keyboard", None),
        ("Traffic Sign (Back)", "pole"),  # Mapillary, as on the hub
        ("Lane Marking - Crosswalk", "ground"),
        ("object--traffic-sign--direction-back", "pole"),  # Mapillary 2.0
        ("object--sign--back", "void"),
        ("construction--barrier--road-median", "sidewalk"),
        ("LABEL_0", None),
    ],
)
def test_names_of_published_models_have_their_category(name, category):
    assert category_of_name(name) == category


def test_names_without_any_category_are_an_error():
    with pytest.raises(ValueError, match=r"none of the 2 class names of x \(LABEL_0, LABEL_1, "):
        label_space_of_names({0: "LABEL_0", 1: "LABEL_1"}, "x")
