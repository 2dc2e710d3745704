"""The exported file against the module: its results, its metadata, and how it is written."""

from collections.abc import Iterator

import numpy as np
import onnx
import pytest
import torch
from drawings import SPACE, VOID, blobs, degenerate
from exported import (
    CUSTOM,
    FIXED,
    RARE,
    SWEPT,
    assert_equal,
    assert_parity,
    by_preset_and_input,
    city,
    in_space,
    model_of,
    noise,
    of_preset,
    presets,
    random_blobs,
    run_of,
    session,
    write_space,
)
from helpers import refuses

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.deployment import export
from ssrvlad_torch.deployment.export import export_head
from ssrvlad_torch.deployment.golden import SIZE, golden_pair
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.deployment.trace import OPSET
from ssrvlad_torch.deployment.verify import verify
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.stages.vanishing_column import MAX_WIDTH
from ssrvlad_torch.taxonomy import label_space_names


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in RARE)) for name in CUSTOM]
)
def test_the_file_and_the_module_agree_at_other_settings(name):
    config = of_preset(**CUSTOM[name])
    for labels in (random_blobs(0), random_blobs(3), noise(2), degenerate()["one pixel"]):
        assert_parity(labels[None], config)


def test_a_file_that_does_not_load_is_refused(tmp_path, monkeypatch):
    """As onnxscript 0.7.0 wrote them."""
    broken = export.head_model(of_preset("default"))
    broken.graph.node[0].input[0] = "nothing"
    monkeypatch.setattr(export, "head_model", lambda *_: broken)
    refuses("cannot run in ONNX Runtime", export_head, of_preset("default"), tmp_path / "x.onnx")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("columns", [SWEPT, pytest.param(COLUMNS, marks=pytest.mark.slow)])
def test_a_sweep_is_that_of_the_module(tmp_path, columns):
    config = of_preset("default")
    export_head(config, tmp_path / "sweep.onnx", columns=columns)
    assert verify(tmp_path / "sweep.onnx").passed
    model = session((tmp_path / "sweep.onnx").read_bytes())
    labels = np.stack([blobs(seed, 97, 211, 12) for seed in range(2)])
    (swept,) = model.run(["descriptor"], {"labels": labels})
    expected = SSRVLAD(config).sweep(torch.from_numpy(labels), columns).numpy()
    assert swept.shape == (2, len(columns), 480)
    np.testing.assert_allclose(swept, expected, atol=1e-6)


def test_a_grid_too_wide_to_count_gives_no_number():
    """The widest grid gives the module's numbers; a wider one gives NaN, which programs refuse."""
    config = of_preset("default")
    street = in_space(*city(1, 0, (120, 160)))
    assert MAX_WIDTH % 160 == 0
    assert_parity(np.tile(street, MAX_WIDTH // 160)[None], config)
    wider = np.zeros((1, config.working_size, MAX_WIDTH + 1), np.uint8)
    descriptor, *_ = run_of(config)(wider)
    assert np.isnan(descriptor).all()


@pytest.mark.parametrize("shape", [FIXED, pytest.param((3, 19, 1), marks=pytest.mark.slow)])
def test_a_file_of_fixed_size_agrees(shape):
    run = run_of(of_preset("default"), "labels", "int32", shape)
    batch = np.stack([blobs(seed, *shape[1:], 9 + seed) for seed in range(shape[0])]).astype("i4")
    assert_equal(run(batch), batch, of_preset("default"))
    descriptor, unknown = run(np.where(batch == 5, 12, batch))
    np.testing.assert_allclose(descriptor, run(np.where(batch == 5, VOID, batch))[0], atol=1e-6)
    assert unknown.tolist() == (batch == 5).sum((1, 2)).tolist()


@by_preset_and_input
def test_a_model_has_its_interface_metadata_and_a_golden_pair(preset, given, dtype):
    config = of_preset(preset)
    model = model_of(config, given, dtype)
    onnx.checker.check_model(model, full_check=True)
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", OPSET)]
    assert not model.functions
    forms = {
        value.name: (
            onnx.helper.tensor_dtype_to_np_dtype(value.type.tensor_type.elem_type).name,
            [axis.dim_param or axis.dim_value for axis in value.type.tensor_type.shape.dim],
        )
        for value in (*model.graph.input, *model.graph.output)
    }
    assert forms == {
        **({"labels": (dtype, ["B", "H", "W"])} if given == "labels" else {}),
        **({"logits": ("float32", ["B", "C", "H", "W"])} if given == "logits" else {}),
        "descriptor": ("float32", ["B", 480]),
        "unknown": ("int64", ["B"]),
        **({"keypoints": ("int64", ["B", 8])} if preset == "paper" else {}),
    }
    assert sum(1 for _ in all_nodes(model.graph)) < 2000, "loops are loops"
    assert len(model.SerializeToString()) < 1 << 20
    head = session(model.SerializeToString())
    metadata = Metadata.from_properties(head.get_modelmeta().custom_metadata_map)
    assert SSRVLADConfig.from_dict(metadata.config) == config
    assert metadata.fingerprint == config.fingerprint
    assert metadata.label_space["name"] == SPACE
    assert list(metadata.interface["inputs"]) == [given]
    assert metadata.interface["opset"] == OPSET
    golden = metadata.golden_arrays()
    inputs = {given: golden.pop(given)}
    for (name, expected), got in zip(golden.items(), head.run(list(golden), inputs), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6, err_msg=name)
    assert preset == "default" or (golden["keypoints"].sum(1) > 20).all()


def all_nodes(graph: onnx.GraphProto) -> Iterator[tuple[onnx.NodeProto, dict[str, int]]]:
    """Every node, also of loops, with the dtypes that are known in its graph."""
    known = {
        value.name: value.type.tensor_type.elem_type
        for value in (*graph.input, *graph.output, *graph.value_info)
    }
    known |= {table.name: table.data_type for table in graph.initializer}
    for node in graph.node:
        yield node, known
        for attribute in node.attribute:
            if attribute.g.node:
                yield from all_nodes(attribute.g)


@presets
def test_arithmetic_is_on_dtypes_that_old_versions_of_the_runtime_have(preset):
    """ONNX Runtime 1.17, for example, cannot add uint64 or compare uint8."""
    kinds = onnx.TensorProto
    anywhere = {kinds.INT32, kinds.INT64, kinds.FLOAT, kinds.DOUBLE}
    operators = {"Add", "Sub", "Mul", "Div", "Mod", "Min", "Max", "Abs", "Equal", "Less", "Greater"}
    seen = set()
    model = onnx.shape_inference.infer_shapes(model_of(of_preset(preset)))
    for node, known in all_nodes(model.graph):
        if node.op_type in operators or node.op_type.startswith(("Reduce", "Arg")):
            dtypes = {known[name] for name in node.input[:1] if name in known}
            more = {"ReduceMin": kinds.UINT8, "ReduceMax": kinds.UINT8, "Equal": kinds.BOOL}
            assert dtypes <= anywhere | {more.get(node.op_type)}, node.name
            seen |= {node.op_type} if dtypes else set()
    assert len(seen & operators) > 5


def test_default_has_no_bits_no_loops_and_no_shape_that_depends_on_labels():
    """What converters to other formats and accelerators take; with a size, all shapes are known."""
    for shape in (None, FIXED):
        model = model_of(of_preset("default"), dtype="int32" if shape else None, shape=shape)
        used = {node.op_type for node, _ in all_nodes(model.graph)}
        assert not used & {"NonZero", "Loop", "If", "Compress", "Unique", "BitShift", "TopK"}
        assert not any(name.startswith("Bitwise") for name in used)
    known = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
    floats = [v for v in known.value_info if v.type.tensor_type.elem_type == onnx.TensorProto.FLOAT]
    assert all(axis.dim_value for value in floats for axis in value.type.tensor_type.shape.dim)
    assert len(floats) > 50


@pytest.mark.parametrize(
    ("preset", "ids", "arguments", "message"),
    [
        ("default", [0], {"input": "pixels"}, "input must be one of labels, logits, got 'pixels'"),
        ("default", [0], {"dtype": "int8"}, "dtype must be one of uint8, int32, int64, got 'int8'"),
        ("default", [0], {"input": "logits", "dtype": "int64"}, "are float32; got 'int64'"),
        ("default", [3], {"input": "logits"}, "own has no class scores, its ids have gaps"),
        ("default", [300, -4], {}, "own has no id from 0 to 255; expected dtype int64"),
        ("default", [0], {"columns": (-8, 0, 5, 9)}, "expected an odd number with 0 in the middle"),
        ("default", [0], {"columns": (0, 4, 8)}, r"0 in the middle, .* got \[0, 4, 8\]"),
        ("paper", [0], {"columns": COLUMNS}, "a sweep needs the aggregation harmonics"),
        ("paper", [0], {"shape": (1, 99, 99)}, "a fixed size is for harmonics"),
        ("default", [0], {"shape": (1, 120, MAX_WIDTH + 1)}, "expected at most 960"),
        ("default", [0], {"shape": (1, 0, 5)}, "expected 1 to 2"),
        ("default", [0], {"shape": (1, 1 << 13, 1 << 13)}, "expected 1 to 2"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(
    preset, ids, arguments, message, tmp_path
):
    space = write_space(tmp_path / "own.yaml", *ids)
    file = tmp_path / "head.onnx"
    file.write_text("before")
    refuses(message, export_head, of_preset(preset, labels_as=str(space)), file, **arguments)
    assert file.read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize(("preset", "given"), [("paper", "labels"), ("default", "logits")])
def test_the_command_writes_the_bytes_that_the_function_writes(ssrvlad, tmp_path, preset, given):
    export_head(of_preset(preset), tmp_path / "head.onnx", given)
    options = ["--labels-as", SPACE, "--input", given, "--preset", preset]
    code, out, _ = ssrvlad("export", "-o", tmp_path / "command.onnx", *options)
    assert code == 0
    assert of_preset(preset).fingerprint in out
    written = [tmp_path / name for name in ("command.onnx", "head.onnx")]
    assert written[0].read_bytes() == written[1].read_bytes()


@pytest.mark.parametrize("space", label_space_names())
def test_every_id_of_the_space_is_in_the_input_and_one_that_is_not(space):
    head = SSRVLAD.from_preset("default", labels_as=space)
    pair = golden_pair(head, "labels", "int64")
    assert pair["labels"].shape[1:] == SIZE
    known = {label.id for label in head.label_space.classes}
    (unknown,) = set(np.unique(pair["labels"])) - known
    assert known < set(np.unique(pair["labels"]))
    assert unknown.astype(np.int32) in known, "32 bits do not tell them apart"
    np.testing.assert_array_equal(pair["unknown"], (pair["labels"] == unknown).sum((1, 2)))
    assert pair["unknown"][-1] > 0


def test_the_golden_input_is_changed_by_every_stage():
    """The golden pair can only check the stages that change something."""
    head = SSRVLAD.from_preset("default", labels_as="camvid-32")
    pair = golden_pair(head, "labels", "uint8")
    assert head.explain(pair["labels"][:1]).layers.shape[2:] != SIZE
    head = SSRVLAD.from_preset("paper", labels_as="camvid-32")
    view = head.explain(pair["labels"][:1])
    assert not torch.equal(view.layers, view.clean_layers)
    assert view.intersections.any()
    counts = golden_pair(head, "labels", "uint8")["keypoints"]
    np.testing.assert_array_equal(counts[:1], view.keypoints.sum((2, 3)))
