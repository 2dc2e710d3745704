"""ONNX graphs as networks."""

import onnx
import pytest
from drawings import SPACE
from helpers import street
from networks import PLAIN, photo, write_graph, write_street
from segmenting import assert_right

from ssrvlad_torch.segmentation import onnx_files, onnx_network
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter

GRAPHS = {
    "dynamic": {},
    "all fixed": {"shape": (1, 3, 24, 32)},
    "a batch of three": {"shape": (3, 3, 24, 32)},
    "channels free": {"shape": ("b", "c", "h", "w")},
    "labels inside": {"labels": True},
    "external weights": {"external": True},
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


def test_a_file_that_has_changed_since_is_not_taken_for_the_graph(tmp_path):
    """Its label maps would be stored and cached as those of the new file."""
    path = write_graph(tmp_path / "net.onnx")
    segmenter, message = Segmenter(OnnxNetwork(path), SPACE, PLAIN), r"net\.onnx has changed or is"
    write_street(path)
    for use in (segmenter.key, lambda: segmenter.features):
        with pytest.raises(ValueError, match=message):
            use()
    path.unlink()
    with pytest.raises(ValueError, match=message):
        segmenter.key()
    assert "is gone" in Segmenter(segmenter.network, SPACE, PLAIN).problem_of_features


def test_a_file_that_is_replaced_while_it_is_opened_is_refused(tmp_path, monkeypatch):
    def opened(*args, **kwargs):
        session = onnx_files.open_session(*args, **kwargs)
        write_street(path)
        return session

    path = write_graph(tmp_path / "net.onnx")
    monkeypatch.setattr(onnx_network, "open_session", opened)
    with pytest.raises(ValueError, match=r"net\.onnx has changed"):
        OnnxNetwork(path)


@pytest.mark.parametrize("options", [{"channels_last": True}, {"scores_last": True}, {}])
@pytest.mark.parametrize("sides", [("h", "w"), (12, 16), (16, 12)])
def test_classes_that_are_as_many_as_rows_or_columns_are_told_apart(tmp_path, options, sides):
    shape = (1, *sides, 3) if "channels_last" in options else (1, 3, *sides)
    path = write_graph(tmp_path / "net.onnx", shape, **options)
    height, width = (12, 16) if sides == ("h", "w") else sides
    labels = [street(seed, height, width) for seed in range(2)]
    segmenter = Segmenter(OnnxNetwork(path), SPACE, PLAIN)
    assert_right(segmenter, [photo(one) for one in labels], labels)


def test_an_ambiguous_axis_of_classes_is_refused(tmp_path):
    path = write_graph(tmp_path / "net.onnx", (1, 3, 12, 12), scores_last=True)
    expected = r"output \(1, 12, 12, 12\) float32 for images of 12x12 can be \(B, C, h, w\) or "
    with pytest.raises(ValueError, match=expected):
        Segmenter(OnnxNetwork(path), SPACE, PLAIN)([photo(street(0, 12, 12))])


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
    with pytest.raises(ValueError, match=message):
        OnnxNetwork(graph_of(inputs, tmp_path / "net.onnx"))
