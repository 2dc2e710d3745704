"""Files in the form arithmetic: results, operators and sizes."""

from functools import cache

import numpy as np
import onnx
import pytest
import torch
from cases import camvid_labels, degenerate, hand_drawn, needs_camvid
from drawings import SPACE, VOID, blobs
from graphs import session
from hypothesis import given
from hypothesis import strategies as st
from test_export import CUSTOM, city, hundreds_of_label_maps, noise, of_preset, random_blobs

from ssrvlad_torch import SSRVLAD, reference
from ssrvlad_torch.deployment import export
from ssrvlad_torch.deployment.arithmetic.vanishing_column import MAX_WIDTH
from ssrvlad_torch.deployment.export import export_head
from ssrvlad_torch.deployment.metadata import Metadata
from ssrvlad_torch.deployment.verify import verify

TRAINIDS = "cityscapes-trainids"
ARITHMETIC = """
Abs Add Cast Concat Div Equal Expand Flatten Floor Gather GatherElements GreaterOrEqual Identity
MatMul Max Min Mul Pad Pow ReduceSum Relu Reshape Sign Slice Split Sqrt Sub Transpose
Unsqueeze Where
"""
"""The operators of a file of fixed size."""
OF_SIZES = "Or And ConstantOfShape Greater Less Range ScatterElements Shape Size"
"""More operators of a file of any size: they compute from sizes and tables only."""


def model_of(config, dtype=None, shape=None, given="labels"):
    return export.head_model(config, given, dtype, (), "arithmetic", shape)


@cache
def run_of(config, dtype=None, shape=None, given="labels"):
    head = session(model_of(config, dtype, shape, given).SerializeToString())
    return lambda batch: head.run(None, {given: batch})


def assert_parity(batch, config, fixed=False):
    descriptor, unknown = run_of(config, batch.dtype.name, batch.shape if fixed else None)(batch)
    expected = SSRVLAD(config)(torch.tensor(batch))
    np.testing.assert_allclose(descriptor, expected, rtol=0, atol=1e-6)
    assert not unknown.any()


@pytest.mark.parametrize("name", [*degenerate(), *hand_drawn()])
def test_degenerate_and_hand_drawn_maps(name):
    labels = {**degenerate(), **hand_drawn()}[name]
    assert_parity(labels[None], of_preset("default"))
    descriptor, _ = run_of(of_preset("default"))(labels[None])
    expected = reference.describe(labels, of_preset("default"))
    np.testing.assert_allclose(descriptor[0], expected, rtol=0, atol=1e-6)


@given(st.integers(0, 10_000))
def test_blobs_and_noise(seed):
    assert_parity(noise(seed)[None], of_preset("default"))
    assert_parity(random_blobs(seed)[None], of_preset("default"))


@needs_camvid
def test_camvid():
    for labels in camvid_labels(100):
        assert_parity(labels[None], of_preset("default"))


@pytest.mark.slow
def test_hundreds_of_label_maps():
    """The maps of the parity test of words, also resized to a fixed size by nearest neighbours."""
    for space, each in hundreds_of_label_maps().items():
        config = of_preset("default", labels_as=space)
        for labels in each:
            assert_parity(labels[None], config)
            rows, columns = (
                np.arange(n) * m // n for n, m in zip((201, 323), labels.shape, strict=True)
            )
            assert_parity(labels[rows[:, None], columns][None], config, fixed=True)


SLOW_SHAPES = [(1, 1, 1), (1, 2, 40), (2, 120, 161), (1, 1081, 90)]


@pytest.mark.parametrize(
    "shape",
    [(3, 19, 1), (1, 241, 317), *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW_SHAPES)],
)
def test_a_fixed_size_of_any_kind(shape):
    config = of_preset("default")
    batch = np.stack([blobs(seed, *shape[1:], 9 + seed) for seed in range(shape[0])])
    assert_parity(batch, config, fixed=True)
    descriptor, unknown = run_of(config, shape=shape)(np.where(batch == 5, 12, batch))
    expected, _ = run_of(config)(np.where(batch == 5, VOID, batch))
    np.testing.assert_allclose(descriptor, expected, rtol=0, atol=1e-6)
    assert unknown.tolist() == (batch == 5).sum((1, 2)).tolist()


@pytest.mark.parametrize("name", [name for name in CUSTOM if CUSTOM[name]["preset"] == "default"])
def test_other_settings(name):
    for labels in (random_blobs(0), noise(2), degenerate()["one pixel"]):
        assert_parity(labels[None], of_preset(**CUSTOM[name]))


@pytest.mark.parametrize("dtype", ["int32", "int64"])
def test_wide_ids_and_ids_below_zero(dtype):
    config = of_preset("default", labels_as="cityscapes-ids")
    labels = np.arange(-1, 34, dtype=dtype)[blobs(3, 140, 150, 8) * 2 + 3]
    labels[:9, :9] = -1
    assert_parity(labels[None], config)
    descriptor, _ = run_of(config, dtype)(labels[None])
    labels[:9, :9] = np.iinfo(dtype).min
    same, unknown = run_of(config, dtype)(labels[None])
    np.testing.assert_array_equal(same, descriptor)
    assert unknown == 81


@pytest.mark.parametrize("shape", [pytest.param(None, marks=pytest.mark.slow), (1, 61, 83)])
def test_class_scores(shape):
    scores = np.random.default_rng(0).normal(size=(1, 12, 61, 83)).astype(np.float32)
    scores += 4 * np.eye(12, dtype=np.float32)[:, blobs(1, 61, 83, 9)[None]].swapaxes(0, 1)
    config = of_preset("default")
    descriptor, _ = run_of(config, shape=shape, given="logits")(scores)
    expected = SSRVLAD(config)(torch.from_numpy(scores))
    np.testing.assert_allclose(descriptor, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("shape", [pytest.param(None, marks=pytest.mark.slow), (2, 130, 90)])
def test_a_sweep_is_that_of_the_module(shape, tmp_path):
    columns, config = (-24, 0, 9), of_preset("default")
    export_head(config, tmp_path / "sweep.onnx", "labels", "uint8", columns, "arithmetic", shape)
    assert verify(tmp_path / "sweep.onnx").passed


@pytest.mark.parametrize("shape", [None, (2, 150, 200)])
def test_no_bits_no_loops_and_nothing_in_64_bits(shape):
    model = model_of(of_preset("default"), shape=shape)
    used = {node.op_type for node in model.graph.node}
    assert used <= {*ARITHMETIC.split()} | ({*OF_SIZES.split()} if not shape else set())
    assert not any(attribute.g.node for node in model.graph.node for attribute in node.attribute)
    if shape:
        known = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph.value_info
        types = {value.name: value.type.tensor_type for value in known}
        outputs = {name for node in model.graph.node for name in node.output}
        assert outputs - types.keys() == {"descriptor", "unknown"}
        kinds = onnx.TensorProto
        allowed = {kinds.FLOAT, kinds.INT32, kinds.BOOL, kinds.UINT8}
        assert {types[name].elem_type for name in outputs & types.keys()} <= allowed
        shapes = [types[name].shape for name in outputs & types.keys()]
        assert all(axis.dim_value for shape in shapes for axis in shape.dim)


@pytest.mark.parametrize("shape", [None, (2, 150, 200)])
def test_the_file_says_what_it_is(shape, tmp_path):
    path = tmp_path / "head.onnx"
    export_head(of_preset("default"), path, form="arithmetic", shape=shape)
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    interface = Metadata.from_properties(properties).interface
    assert interface["form"] == "arithmetic"
    assert interface["inputs"]["labels"]["shape"] == list(shape or ("B", "H", "W"))
    assert verify(path).passed


def test_what_cannot_be_counted_is_nan_or_refused():
    config = of_preset("default", labels_as=TRAINIDS)
    (street,) = city(1, 0, (120, 160))
    assert_parity(np.tile(street, (1, 1, MAX_WIDTH // 160)).reshape(1, 120, MAX_WIDTH), config)
    wider = np.zeros((1, 120, MAX_WIDTH + 1), np.uint8)
    assert np.isnan(run_of(config)(wider)[0]).all()
    for shape in (wider.shape, (1, 0, 5), (0, 5, 5), (1, 1 << 13, 1 << 13)):
        with pytest.raises(ValueError, match="expected"):
            model_of(config, shape=shape)


def test_the_command_line(ssrvlad, tmp_path):
    path = tmp_path / "head.onnx"
    given = ("export", "-o", path, "--labels-as", SPACE, "--form", "arithmetic")
    assert ssrvlad(*given, "--size", "30x40", "--batch", 2)[0] == 0
    (labels,) = onnx.load(path).graph.input
    assert [axis.dim_value for axis in labels.type.tensor_type.shape.dim] == [2, 30, 40]
    for more, problem in {("--size", "30"): "--size 30", ("--batch", 2): "--batch 2"}.items():
        code, _, errors = ssrvlad(*given, *more)
        assert (code, len(errors)) == (2, 1)
        assert problem in errors[0]


@pytest.mark.parametrize(
    ("preset", "form", "shape", "problem"),
    [
        ("paper", "arithmetic", None, "form arithmetic is for harmonics"),
        ("default", "standard", (1, 99, 99), "form standard takes any size"),
        ("default", "bits", None, "form must be one of standard, arithmetic"),
    ],
)
def test_forms_that_do_not_exist(preset, form, shape, problem):
    with pytest.raises(ValueError, match=problem):
        export.head_model(of_preset(preset), form=form, shape=shape)
