"""Fused files against the network and the module run one after the other."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
import torch
from drawings import SPACE, blobs
from graphs import session
from networks import CLASSES, photo, write_graph
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.deployment import model_file
from ssrvlad_torch.deployment.export import export_head, head_model
from ssrvlad_torch.deployment.fuse import DIGEST, NETWORK, fuse
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.deployment.model_file import graph_digest, load_model
from ssrvlad_torch.deployment.verify import verify

HEADS = ("descriptor", "keypoints", "unknown")
CONFIG = SSRVLADConfig.from_preset("default", labels_as=SPACE)
Images = npt.NDArray[Any]


@cache
def built(config: SSRVLADConfig, dtype: str) -> bytes:
    return head_model(config, "labels", dtype).SerializeToString()


@pytest.fixture(autouse=True)
def heads_are_built_once(monkeypatch):
    """Most of the time of fusing a tiny network goes into the head."""

    def model(config: SSRVLADConfig, _: str, dtype: str) -> onnx.ModelProto:
        return onnx.load_from_string(built(config, dtype))

    monkeypatch.setattr(sys.modules[fuse.__module__], "head_model", model)


class UNet(nn.Module):
    """Two levels, random weights, skip connections of any size."""

    def __init__(self, classes: int = CLASSES) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.down = nn.ModuleList([nn.Conv2d(3, 8, 3, 1, 1), nn.Conv2d(8, 16, 3, 2, 1)])
        self.norm = nn.BatchNorm2d(16)
        self.up = nn.Conv2d(24, classes, 3, 1, 1)

    def forward(self, images: Tensor) -> Tensor:
        fine = relu(self.down[0](images))
        coarse = relu(self.norm(self.down[1](fine)))
        size = fine.shape[2:]
        enlarged = interpolate(coarse, size=size, mode="bilinear", align_corners=False)
        return self.up(torch.cat([fine, enlarged], 1))


class Labelled(UNet):
    """The U-Net with the argmax inside."""

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(images).argmax(1)


class FCN(UNet):
    """A mapping with an auxiliary output, as torchvision's networks give it, at stride 2."""

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        scores = super().forward(images)
        return {"out": scores[:, :, ::2, ::2], "aux": -scores}


def exported(network: nn.Module, path: Path, dynamic: bool, **names: list[str]) -> Path:
    images = torch.rand(2, 3, 64, 96)
    dim = torch.export.Dim
    shapes = {"images": {0: dim("n"), 2: dim("rows", min=8), 3: dim("columns", min=8)}}
    torch.onnx.export(
        network.eval(),
        (images,),
        path,
        input_names=["images"],
        dynamic_shapes=shapes if dynamic else None,
        dynamo=True,
        verbose=False,
        external_data=False,
        **names,
    )
    return path


def pictures(height: int = 133, width: int = 171, count: int = 2) -> Images:
    """``(B, 3, H, W)`` float32 photos, 0 to 1."""
    photos = [photo(blobs(seed, height, width, 12)) for seed in range(count)]
    return np.stack(photos).transpose(0, 3, 1, 2).astype(np.float32) / 255


def graph_of(nodes: list[Any], outputs: dict[str, int], opset: int, **tables: Any) -> Any:
    """A graph from ``images`` float32 ``(B, 3, H, W)``."""
    made = [
        helper.make_tensor_value_info(name, kind, ["B", *[f"{name}_{n}" for n in range(rank - 1)]])
        for name, (kind, rank) in outputs.items()
    ]
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["B", 3, "H", "W"])
    weights = [numpy_helper.from_array(array, name) for name, array in tables.items()]
    graph = helper.make_graph(nodes, "network", [images], made, weights)
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=min(8, opset - 5)
    )


def conv_weight(classes: int = CLASSES) -> Images:
    return np.random.default_rng(3).normal(size=(classes, 3, 3, 3)).astype(np.float32)


SCORES = {"scores": (TensorProto.FLOAT, 4)}


def assert_fused(
    network: Path, fused: Path, images: Images, config: SSRVLADConfig = CONFIG, taken: int = 0
) -> dict[str, Images]:
    """The network's outputs as they were, and the head's as the module makes them of those."""
    alone, whole = session(network), session(fused)
    given = alone.get_inputs()[0].name
    names = [value.name for value in whole.get_outputs()]
    kept = [value.name for value in alone.get_outputs()]
    assert names[:-3] == kept
    before = alone.run(None, {given: images})
    after = whole.run(None, {given: images})
    for old, new in zip(before, after, strict=False):
        np.testing.assert_allclose(new, old, rtol=1e-4, atol=1e-4)
    output = torch.from_numpy(after[taken])
    if not output.is_floating_point():
        output = output.reshape(len(output), *images.shape[2:])
    view = SSRVLAD(config).explain(output)
    descriptor, keypoints, unknown = after[-3:]
    np.testing.assert_array_equal(keypoints, view.keypoints.sum((2, 3)))
    np.testing.assert_allclose(descriptor, view.descriptor, rtol=0, atol=1e-6)
    assert keypoints.any()
    assert not unknown.any()
    return dict(zip(names, after, strict=True))


def assert_verified(file: Path) -> None:
    found = verify(file)
    assert found.passed, found
    assert [check.name for check in found.checks] == ["golden image", "golden pair", "module"]


@pytest.mark.parametrize("dynamic", [True, False])
@pytest.mark.parametrize("network", [UNet, Labelled])
def test_networks_of_the_torch_exporter(network, dynamic, tmp_path):
    file = exported(network(), tmp_path / "seg.onnx", dynamic)
    fuse(file, CONFIG, tmp_path / "place.onnx")
    images = pictures() if dynamic else pictures(64, 96)
    assert_fused(file, tmp_path / "place.onnx", images)
    assert_verified(tmp_path / "place.onnx")


def test_a_mapping_with_an_auxiliary_output(tmp_path):
    file = exported(FCN(), tmp_path / "seg.onnx", True, output_names=["out", "aux"])
    made = fuse(file, CONFIG, tmp_path / "place.onnx")
    assert made.output == "out"
    assert_fused(file, tmp_path / "place.onnx", pictures())
    assert fuse(file, CONFIG, tmp_path / "place.onnx", "aux").output == "aux"
    assert_fused(file, tmp_path / "place.onnx", pictures(), taken=1)


def test_segformer_with_random_weights(tmp_path):
    from transformers import SegformerConfig, SegformerForSemanticSegmentation

    config = SegformerConfig(
        num_labels=CLASSES, depths=[1] * 4, hidden_sizes=[8, 16, 24, 32], decoder_hidden_size=16
    )
    network = SegformerForSemanticSegmentation(config).eval()
    file = tmp_path / "seg.onnx"
    torch.onnx.export(
        network, (torch.rand(1, 3, 128, 160),), file, output_names=["logits"], dynamo=True
    )
    fuse(file, CONFIG, tmp_path / "place.onnx")
    assert_fused(file, tmp_path / "place.onnx", pictures(128, 160, 1))


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"labels": True},
        {"dtype": "half"},
        {"dtype": "double"},
        {"external": True},
        {"shape": (1, 3, 90, 120)},
    ],
)
@pytest.mark.parametrize("preset", ["paper", "default"])
def test_forms_of_the_output(form, preset, tmp_path):
    config = SSRVLADConfig.from_preset(preset, labels_as=SPACE)
    network = write_graph(tmp_path / "seg.onnx", **form)
    fuse(network, config, tmp_path / "place.onnx")
    images = pictures(90, 120, 1) if "shape" in form else pictures()
    if form.get("dtype"):
        images = images.astype(form["dtype"])
    assert_fused(network, tmp_path / "place.onnx", images, config)


def test_channels_last(tmp_path):
    form = {"channels_last": True, "shape": ("b", "h", "w", 3)}
    network = write_graph(tmp_path / "seg.onnx", **form)
    fuse(network, CONFIG, tmp_path / "place.onnx")
    planes = write_graph(tmp_path / "planes.onnx")
    fuse(planes, CONFIG, tmp_path / "other.onnx")
    images = pictures()
    last = session(tmp_path / "place.onnx").run(None, {"images": images.transpose(0, 2, 3, 1)})
    first = session(tmp_path / "other.onnx").run(None, {"images": images})
    for got, expected in zip(last[1:], first[1:], strict=True):
        np.testing.assert_array_equal(got, expected)


def half_network() -> Any:
    """Weights, arithmetic and scores in half precision."""
    nodes = [
        helper.make_node("Cast", ["images"], ["half"], to=TensorProto.FLOAT16),
        helper.make_node("Conv", ["half", "weight"], ["scores"], pads=[1] * 4, strides=[2, 2]),
    ]
    outputs = {"scores": (TensorProto.FLOAT16, 4)}
    return graph_of(nodes, outputs, 17, weight=conv_weight().astype(np.float16))


def test_scores_of_half_precision(tmp_path):
    onnx.save(half_network(), tmp_path / "seg.onnx")
    fuse(tmp_path / "seg.onnx", CONFIG, tmp_path / "place.onnx")
    got = assert_fused(tmp_path / "seg.onnx", tmp_path / "place.onnx", pictures())
    assert got["scores"].dtype == np.float16
    assert_verified(tmp_path / "place.onnx")


def test_an_int8_graph(tmp_path):
    from onnxruntime import quantization

    class Photos(quantization.CalibrationDataReader):
        def __init__(self) -> None:
            self.rest = [{"images": pictures(count=1)}]

        def get_next(self) -> Any:
            return self.rest.pop() if self.rest else None

    nodes = [
        helper.make_node("Conv", ["images", "first"], ["found"], pads=[1] * 4),
        helper.make_node("Relu", ["found"], ["positive"]),
        helper.make_node("Conv", ["positive", "last"], ["scores"], pads=[1] * 4),
    ]
    last = np.random.default_rng(4).normal(size=(CLASSES, 9, 3, 3)).astype(np.float32)
    onnx.save(graph_of(nodes, SCORES, 17, first=conv_weight(9), last=last), tmp_path / "float.onnx")
    network = tmp_path / "seg.onnx"
    quantization.quantize_static(
        tmp_path / "float.onnx", network, Photos(), quant_format=quantization.QuantFormat.QDQ
    )
    assert "QuantizeLinear" in {node.op_type for node in load_model(network).graph.node}
    fuse(network, CONFIG, tmp_path / "place.onnx")
    assert_fused(network, tmp_path / "place.onnx", pictures())
    assert_verified(tmp_path / "place.onnx")


def old_network() -> Any:
    """Opset 11, where Softmax works on the last axes as one, and axes are attributes."""
    nodes = [
        helper.make_node("Conv", ["images", "weight"], ["found"], pads=[1] * 4, strides=[2, 2]),
        helper.make_node("Unsqueeze", ["found"], ["five"], axes=[0]),
        helper.make_node("Squeeze", ["five"], ["four"], axes=[0]),
        helper.make_node("Resize", ["four", "", "scales"], ["large"], mode="nearest"),
        helper.make_node("Transpose", ["large"], ["last"], perm=[0, 2, 3, 1]),
        helper.make_node("Softmax", ["last"], ["shares"], axis=3),
        helper.make_node("Transpose", ["shares"], ["scores"], perm=[0, 3, 1, 2]),
    ]
    scales = np.array([1, 1, 2, 2], np.float32)
    nodes[3].input[1] = "roi"
    return graph_of(
        nodes, SCORES, 11, weight=conv_weight(), scales=scales, roi=np.zeros(0, np.float32)
    )


@pytest.mark.parametrize("opset", [18, 19, 21, 23])
def test_opsets_from_the_heads_own_upwards_stay(opset, tmp_path):
    nodes = [helper.make_node("Conv", ["images", "weight"], ["scores"], pads=[1] * 4)]
    model = graph_of(nodes, SCORES, opset, weight=conv_weight())
    model.ir_version = 10
    onnx.save(model, tmp_path / "seg.onnx")
    fuse(tmp_path / "seg.onnx", CONFIG, tmp_path / "place.onnx")
    fused = load_model(tmp_path / "place.onnx")
    assert [(one.domain, one.version) for one in fused.opset_import] == [("", opset)]
    assert fused.ir_version == 10
    onnx.checker.check_model(fused, full_check=True)
    assert_fused(tmp_path / "seg.onnx", tmp_path / "place.onnx", pictures())
    assert_verified(tmp_path / "place.onnx")


def test_an_old_opset_is_raised(tmp_path):
    onnx.save(old_network(), tmp_path / "seg.onnx")
    fuse(tmp_path / "seg.onnx", CONFIG, tmp_path / "place.onnx")
    fused = load_model(tmp_path / "place.onnx")
    assert [one.version for one in fused.opset_import] == [18]
    assert fused.ir_version == 8
    assert_fused(tmp_path / "seg.onnx", tmp_path / "place.onnx", pictures())
    assert_verified(tmp_path / "place.onnx")


def test_names_that_clash(tmp_path):
    """The network has the head's names: of an output, of a value, of what comes with the prefix."""
    nodes = [
        helper.make_node("Conv", ["images", "table_0"], ["descriptor"], "thin", pads=[1] * 4),
        helper.make_node("Neg", ["descriptor"], ["ssrvlad/labels"]),
        helper.make_node("Neg", ["ssrvlad/labels"], ["labels"]),
        helper.make_node("ReduceMax", ["labels"], ["keypoints"], axes=[1], keepdims=0),
    ]
    outputs = {"labels": (TensorProto.FLOAT, 4), "keypoints": (TensorProto.FLOAT, 3)}
    onnx.save(graph_of(nodes, outputs, 17, table_0=conv_weight()), tmp_path / "seg.onnx")
    made = fuse(tmp_path / "seg.onnx", CONFIG, tmp_path / "place.onnx")
    assert made.heads["unknown"] == "unknown"
    assert made.prefix == "_ssrvlad/"
    got = assert_fused(tmp_path / "seg.onnx", tmp_path / "place.onnx", pictures())
    assert list(got)[2:] == ["_ssrvlad/descriptor", "_ssrvlad/keypoints", "unknown"]
    assert_verified(tmp_path / "place.onnx")


def test_a_network_whose_input_is_no_image(tmp_path):
    """The golden pair is then the head's alone."""
    nodes = [helper.make_node("Add", ["images", "more"], ["scores"])]
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", CLASSES, "H", "W"])
        for name in ("images", "more", "scores")
    ]
    graph = helper.make_graph(nodes, "two", values[:2], values[2:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    onnx.save(model, tmp_path / "seg.onnx")
    fuse(tmp_path / "seg.onnx", CONFIG, tmp_path / "place.onnx")
    scores = np.random.default_rng(0).normal(size=(1, CLASSES, 70, 80)).astype(np.float32)
    descriptor = session(tmp_path / "place.onnx").run(
        ["descriptor"], {"images": scores, "more": scores}
    )[0]
    expected = SSRVLAD(CONFIG)(torch.from_numpy(scores))
    np.testing.assert_allclose(descriptor, expected, rtol=0, atol=1e-6)
    found = verify(tmp_path / "place.onnx")
    assert found.passed
    assert [check.name for check in found.checks] == ["golden pair", "module"]


def test_the_metadata(tmp_path):
    network = write_graph(tmp_path / "seg.onnx")
    own = onnx.load(network)
    onnx.helper.set_model_props(own, {"author": "somebody"})
    onnx.save(own, network)
    fuse(network, CONFIG, tmp_path / "place.onnx")
    whole = session(tmp_path / "place.onnx")
    properties = whole.get_modelmeta().custom_metadata_map
    metadata = Metadata.from_properties(properties)
    assert properties["author"] == "somebody"
    assert metadata.fingerprint == CONFIG.fingerprint
    assert list(metadata.interface["inputs"]) == ["images"]
    assert {*metadata.interface["outputs"]} == {"found", *HEADS}
    assert json.loads(properties[NETWORK])["name"] == "seg.onnx"
    golden = metadata.golden_arrays()
    results = whole.run([*HEADS], {"images": golden["images"]})
    for name, got in zip(HEADS, results, strict=True):
        np.testing.assert_allclose(got, golden[name], rtol=0, atol=1e-6)
    assert golden["keypoints"].any()


def test_what_is_too_large_for_one_file_becomes_two(tmp_path, monkeypatch):
    network = write_graph(tmp_path / "seg.onnx")
    fuse(network, CONFIG, tmp_path / "one.onnx")
    monkeypatch.setattr(model_file, "LARGEST", 10_000)
    for _ in range(2):
        fuse(network, CONFIG, tmp_path / "two.onnx")
    (weights,) = tmp_path.glob("two.onnx.*.data")
    assert weights.stat().st_size > 1000
    assert len(list(tmp_path.iterdir())) == 4
    one, two = (load_model(tmp_path / name) for name in ("one.onnx", "two.onnx"))
    assert graph_digest(one) == graph_digest(two)
    assert_fused(network, tmp_path / "two.onnx", pictures())
    assert_verified(tmp_path / "two.onnx")


def test_the_same_file_twice_has_the_same_bytes(tmp_path):
    network = write_graph(tmp_path / "seg.onnx")
    for name in ("one.onnx", "other.onnx"):
        fuse(network, CONFIG, tmp_path / name)
    one, other = (tmp_path.joinpath(name).read_bytes() for name in ("one.onnx", "other.onnx"))
    assert one == other
    properties = {entry.key: entry.value for entry in onnx.load_from_string(one).metadata_props}
    assert properties[DIGEST] == graph_digest(load_model(tmp_path / "one.onnx"))


def truncated(path: Path) -> None:
    content = write_graph(path).read_bytes()
    path.write_bytes(content[: len(content) // 2])


def outside(path: Path) -> None:
    model = onnx.load(write_graph(path))
    weight = model.graph.initializer[0]
    (path.parent.parent / "secret").write_bytes(weight.raw_data)
    onnx.external_data_helper.set_external_data(weight, "../secret", 0, len(weight.raw_data))
    weight.ClearField("raw_data")
    path.write_bytes(model.SerializeToString())


def without_weights(path: Path) -> None:
    write_graph(path, external=True)
    path.with_suffix(".data").unlink()


def without_output(path: Path) -> None:
    nodes = [helper.make_node("ReduceMean", ["images"], ["vector"], axes=[2, 3], keepdims=0)]
    onnx.save(graph_of(nodes, {"vector": (TensorProto.FLOAT, 2)}, 17), path)


def two_outputs(path: Path) -> None:
    write_graph(path, aux=True)


def wrong_count(path: Path) -> None:
    nodes = [helper.make_node("Conv", ["images", "weight"], ["scores"])]
    onnx.save(graph_of(nodes, SCORES, 17, weight=conv_weight(7)), path)


def wrong_ids(path: Path) -> None:
    nodes = [
        helper.make_node("Conv", ["images", "weight"], ["classes"]),
        helper.make_node("ArgMax", ["classes"], ["ids"], axis=1, keepdims=0),
    ]
    outputs = {"ids": (TensorProto.INT64, 3)}
    onnx.save(graph_of(nodes, outputs, 17, weight=conv_weight(40)), path)


def bfloat16(path: Path) -> None:
    nodes = [
        helper.make_node("Conv", ["images", "weight"], ["classes"]),
        helper.make_node("Cast", ["classes"], ["scores"], to=TensorProto.BFLOAT16),
    ]
    outputs = {"scores": (TensorProto.BFLOAT16, 4)}
    onnx.save(graph_of(nodes, outputs, 17, weight=conv_weight()), path)


BAD = {
    "no file": (lambda _: None, r"seg\.onnx does not exist"),
    "not ONNX": (lambda path: path.write_text("hello"), r"cannot be read as an ONNX graph"),
    "empty": (lambda path: path.write_bytes(b""), r"seg\.onnx is no ONNX graph: it has no nodes"),
    "truncated": (truncated, r"cannot be read as an ONNX graph"),
    "weights outside": (outside, r"\.\./secret"),
    "weights missing": (without_weights, r"seg\.data"),
    "no output": (without_output, r"no output fits label space camvid-11: got vector \(2, 3\)"),
    "two outputs": (two_outputs, r"several outputs could be labels: found .*, aux .*"),
    "class count": (wrong_count, r"no output fits .*scores \(2, 7, .*wanted .*C = 11 or 12"),
    "ids": (wrong_ids, r"label id \d+ \(\d+ pixels\).* is not in label space camvid-11"),
    "bfloat16": (bfloat16, r"output scores is bfloat16, which ONNX Runtime cannot give"),
    "fused": (
        lambda path: fuse(write_graph(path), CONFIG, path),
        r"has a head already; wanted the network alone",
    ),
    "head": (lambda path: export_head(CONFIG, path), r"has a head already"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(kind, ssrvlad, tmp_path):
    write, message = BAD[kind]
    network, target = tmp_path / "seg.onnx", tmp_path / "out" / "place.onnx"
    write(network)
    target.parent.mkdir()
    target.write_text("before")
    code, out, err = ssrvlad("fuse", network, "-o", target, "--labels-as", SPACE)
    assert (code, out, len(err)) == (2, "", 1)
    (line,) = err
    assert "seg.onnx" in line
    assert re.search(message, line), line
    assert target.read_text() == "before"
    assert [one.name for one in target.parent.iterdir()] == ["place.onnx"]


def test_an_unknown_output_label_space_or_folder_is_named(ssrvlad, tmp_path):
    network = write_graph(tmp_path / "seg.onnx")
    fine = ["fuse", network, "-o", tmp_path / "place.onnx", "--labels-as", SPACE]
    code, _, err = ssrvlad(*fine, "--output", "logits")
    assert (code, len(err)) == (2, 1)
    assert "there is no output 'logits'; the outputs are found" in err[0]
    code, _, err = ssrvlad("fuse", network, "-o", tmp_path / "x.onnx", "--labels-as", "moon")
    assert (code, len(err)) == (2, 1)
    assert "unknown label space 'moon'" in err[0]
    code, _, err = ssrvlad("fuse", network, "-o", tmp_path / "no" / "x.onnx", "--labels-as", SPACE)
    assert (code, len(err)) == (2, 1)
    assert "there is no folder" in err[0]
    assert [path.name for path in tmp_path.iterdir()] == ["seg.onnx"]


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime"])
def test_a_missing_extra_is_named(missing, tmp_path):
    network = write_graph(tmp_path / "seg.onnx")
    arguments = ["ssrvlad", "fuse", str(network), "-o", "place.onnx", "--labels-as", SPACE]
    code = (
        f"import sys; sys.modules[{missing!r}] = None; sys.argv = {arguments!r};"
        "from ssrvlad_torch.cli.main import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 2
    assert "pip install ssrvlad-torch[onnx]" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["seg.onnx"]


def test_the_command_and_the_script_write_what_the_function_writes(ssrvlad, tmp_path):
    network = write_graph(tmp_path / "seg.onnx", aux=True)
    fuse(network, CONFIG, tmp_path / "place.onnx", "found")
    options = ["--labels-as", SPACE, "--output", "found"]
    code, out, err = ssrvlad("fuse", network, "-o", tmp_path / "command.onnx", *options)
    assert (code, err) == (0, [])
    assert CONFIG.fingerprint in out
    script = Path(__file__).parents[1] / "export" / "fuse.py"
    command = [sys.executable, script, network, tmp_path / "script.onnx", *options]
    subprocess.run(command, check=True)
    names = ("place.onnx", "command.onnx", "script.onnx")
    assert len({(tmp_path / name).read_bytes() for name in names}) == 1
