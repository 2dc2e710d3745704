"""The whole method against the reference, and what the module accepts and refuses."""

import copy
import dataclasses
import json
import pickle

import numpy as np
import pytest
import torch
from drawings import (
    CAR,
    ROAD,
    SPACE,
    TREE,
    VOID,
    assert_equals_reference,
    blobs,
    camvid_labels,
    needs_camvid,
)
from helpers import refused, refuses
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from torch.utils._python_dispatch import TorchDispatchMode

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.config import CHOICES, PRESETS
from ssrvlad_torch.datasets.synthetic_city import SyntheticCity
from ssrvlad_torch.stages.harmonics import waves
from ssrvlad_torch.stages.shape_context import PAIRS_AT_ONCE
from ssrvlad_torch.taxonomy import label_space

DEFAULT = SSRVLADConfig.from_preset("default", labels_as=SPACE)
PAPER = SSRVLADConfig.from_preset("paper", labels_as=SPACE)

presets = pytest.mark.parametrize("preset", PRESETS)


def batch_of_blobs(count: int = 3, height: int = 61, width: int = 83) -> torch.Tensor:
    return torch.from_numpy(np.stack([blobs(seed, height, width, 13) for seed in range(count)]))


def with_few_harmonics(
    harmonics: int, boundary_harmonics: int, rings: int, sectors: int, **settings
) -> SSRVLADConfig:
    """A config with no more harmonics than there are basis functions."""
    most = len(waves(rings, sectors))
    return SSRVLADConfig(
        harmonics=min(harmonics, most),
        boundary_harmonics=min(boundary_harmonics, most),
        rings=rings,
        sectors=sectors,
        **settings,
    )


@settings(max_examples=80, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    grain=st.floats(1, 20),
    config=st.builds(
        with_few_harmonics,
        labels_as=st.just(SPACE),
        working_size=st.sampled_from([None, 5, 17, 32]),
        opening=st.sampled_from([0.0, 0.02, 0.05]),
        closing=st.sampled_from([0.0, 0.05, 0.1]),
        hole_area=st.floats(0, 0.1),
        region_area=st.floats(0, 0.05),
        thinning=st.sampled_from(CHOICES["thinning"]),
        rings=st.integers(1, 6),
        sectors=st.sampled_from([1, 2, 4, 7, 12]),
        radius=st.floats(0.05, 1.0),
        inner_radius=st.floats(0.02, 1.0),
        context=st.sampled_from(CHOICES["context"]),
        aggregation=st.sampled_from(CHOICES["aggregation"]),
        anchor=st.sampled_from(CHOICES["anchor"]),
        harmonics=st.integers(1, 60),
        boundary_harmonics=st.integers(1, 60),
        spectral_weight=st.floats(0, 2),
        power=st.floats(0.5, 1.0),
    ),
)
def test_equals_the_reference_on_blobs_with_any_settings(seed, height, width, grain, config):
    assert_equals_reference(blobs(seed, height, width, grain), config)


@needs_camvid
@pytest.mark.parametrize(
    ("preset", "step"),
    [
        *(("default", 400), ("paper", 1000)),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("default", 1), ("paper", 4))),
    ],
)
def test_equals_the_reference_on_camvid(preset, step):
    for labels in camvid_labels(step):
        assert_equals_reference(labels, SSRVLADConfig.from_preset(preset, labels_as=SPACE))


def test_every_integer_dtype_array_and_view_gives_the_same():
    head, batch = SSRVLAD(DEFAULT), batch_of_blobs()
    before, expected = batch.clone(), head(batch)
    array = batch.numpy()
    for form in (array, array.astype(">i4"), array[:, ::-1][:, ::-1]):
        assert torch.equal(head(form), expected)
    for bits in (8, 16, 32, 64):
        assert torch.equal(head(batch.to(getattr(torch, f"int{bits}"))), expected)
        assert torch.equal(head(batch.to(getattr(torch, f"uint{bits}"))), expected)
    with torch.inference_mode():
        assert torch.equal(head(batch), expected)
    for view in (batch.transpose(1, 2), batch[:, ::2, ::3], batch[:1].expand(2, -1, -1)):
        assert not view.is_contiguous()
        assert torch.equal(head(view), head(view.contiguous()))
    assert torch.equal(batch, before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("classes", [11, 12])
def test_class_scores_take_the_best_class_and_of_equal_ones_the_first(dtype, classes):
    head = SSRVLAD(DEFAULT)
    labels = batch_of_blobs().clamp(max=classes - 1).long()
    scores = torch.nn.functional.one_hot(labels, classes).movedim(-1, 1).to(dtype)
    assert torch.equal(head(scores), head(labels))
    outputs = {"aux": -scores, "out": scores, "embedding": scores.mean((2, 3))}
    assert torch.equal(head(outputs), head(labels))
    assert torch.equal(head({"ids": labels, "depth": scores[:, :1]}), head(labels))
    refuses("labels of camvid-11, 2 fit: got a .*, b ", head, {"a": scores, "b": scores})
    scores = torch.zeros(1, 11, 20, 20)
    scores[:, ROAD] = scores[:, TREE] = float("inf")
    assert torch.equal(head(scores), head(torch.full((1, 20, 20), ROAD)))


def test_an_empty_image_is_zero_and_flagged():
    labels = torch.tensor([VOID, CAR, TREE]).view(3, 1, 1).repeat(1, 40, 50)
    labels[2, :20] = ROAD
    view = SSRVLAD(DEFAULT).explain(labels)
    assert view.empty.tolist() == [True, True, False]
    assert not view.descriptor[:2].any()


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (torch.zeros(1, 4, 4), r"must hold integer ids, got \(1, 4, 4\) float32"),
        (torch.zeros(1, 4, 4, dtype=torch.bool), "must hold integer ids"),
        (torch.zeros(1, 11, 4, 4, dtype=torch.int64), "class scores must be floating point"),
        (
            torch.zeros(4, 4, dtype=torch.uint8),
            r"expected \(B, H, W\) label ids or .* got \(4, 4\)",
        ),
        (torch.tensor(3), "expected .*label ids"),
        (torch.zeros(1, 4, 4, dtype=torch.complex64), "expected .*label ids"),
        (torch.zeros(0, 4, 4, dtype=torch.uint8), "at least one image of at least one pixel"),
        (torch.zeros(2, 0, 4, dtype=torch.uint8), r"at least one pixel, got \(2, 0, 4\)"),
        (torch.zeros(1, 19, 4, 4), "have 19 classes; label space camvid-11 takes 11 or 12"),
        (torch.full((1, 11, 2, 2), torch.nan), "hold 44 NaN values"),
        (torch.full((1, 2, 2), 12), r"label id 12 \(4 pixels\) is not in label space camvid-11"),
        (torch.ones(1, 4, 4, device="meta"), "expected a dense tensor in memory"),
        (torch.ones(1, 4, 4, dtype=torch.int64).to_sparse(), "expected a dense tensor in memory"),
        (Image.new("L", (4, 4)), r"got PIL Image; a picture's labels are np\.asarray"),
    ],
)
def test_bad_input_is_refused_by_shape_and_type(labels, message):
    refuses(message, SSRVLAD(DEFAULT), labels)


OPERATOR = "ssrvlad.describe.default"


def test_the_head_is_compiled_as_one_operator_and_paper_exported_as_one(core):
    head, batch = SSRVLAD.from_preset("paper", labels_as=SPACE), batch_of_blobs(2, 61, 83)
    assert torch.equal(
        torch.compile(SSRVLAD(DEFAULT), fullgraph=True)(batch), SSRVLAD(DEFAULT)(batch)
    )
    program = torch.export.export(head, (batch,))
    assert torch.equal(program.module()(batch), head(batch))
    assert OPERATOR in [str(node.target) for node in program.graph.nodes]


@pytest.mark.parametrize(
    ("head", "shape"),
    [(SSRVLAD(DEFAULT), ()), pytest.param(SSRVLAD(DEFAULT, [-3, 5]), (2,), marks=pytest.mark.slow)],
)
def test_default_is_exported_as_its_stages_for_every_size(head, shape):
    """An id outside the label space makes an exported descriptor NaN: a graph cannot raise."""
    dims = (dict.fromkeys(range(3), torch.export.Dim.AUTO),)
    program = torch.export.export(head, (batch_of_blobs(2, 66, 98),), dynamic_shapes=dims)
    assert OPERATOR not in [str(node.target) for node in program.graph.nodes]
    for size in ((3, 66, 98), (2, 150, 211), (2, 121, 600)):
        batch = batch_of_blobs(*size)
        torch.testing.assert_close(program.module()(batch), head(batch), rtol=0, atol=1e-6)
        batch[-1, 0, 0] = 200
        outcome = program.module()(batch)
        assert outcome.shape == (size[0], *shape, 480)
        assert outcome[-1].isnan().all()
        assert not outcome[:-1].isnan().any()


def test_a_network_with_the_head_is_compiled_and_exported(core):
    torch.manual_seed(0)
    whole = torch.nn.Sequential(torch.nn.Conv2d(3, 11, 3, padding=1), SSRVLAD(DEFAULT)).eval()
    images, other = torch.rand(2, 3, 61, 83), torch.rand(2, 3, 61, 83)
    with torch.no_grad():
        expected = whole(other)
        compiled = torch.compile(whole, fullgraph=True, backend="aot_eager")  # inductor rounds
        assert torch.equal(compiled(other), expected)
        for strict in (False, True):
            program = torch.export.export(whole, (images,), strict=strict)
            torch.testing.assert_close(program.module()(other), expected, rtol=0, atol=1e-6)
        refuses("NaN", compiled, other * torch.nan)


@pytest.mark.parametrize("head", [SSRVLAD(DEFAULT), SSRVLAD(PAPER), SSRVLAD(DEFAULT, [0])])
def test_torch_jit_trace_and_the_old_exporter_are_refused(head, tmp_path):
    with refused(r"torch\.jit\.trace cannot record SSRVLAD", by=RuntimeError):
        torch.jit.trace(head, batch_of_blobs(1))
    with refused(r"nor can torch\.onnx\.export\(dynamo=False\)", by=RuntimeError):
        torch.onnx.export(head, (batch_of_blobs(1),), tmp_path / "head.onnx", dynamo=False)


class LargestTensor(TorchDispatchMode):
    """Remembers the bytes of the largest tensor that any operation makes."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for tensor in result if isinstance(result, (tuple, list)) else (result,):
            if isinstance(tensor, torch.Tensor):
                self.bytes = max(self.bytes, tensor.untyped_storage().nbytes())
        return result


@pytest.mark.parametrize("specks", [0, 4000])
@presets
def test_no_tensor_outgrows_the_image(preset, specks):
    """Keypoints times skeleton pixels would be gigabytes here; they are counted in chunks."""
    bare = {"closing": 0.0, "hole_area": 0.0, "region_area": 0.0}
    head = SSRVLAD.from_preset(preset, labels_as=SPACE, **bare)
    labels = torch.full((2, 400, 500), VOID, dtype=torch.uint8)
    rng = np.random.default_rng(0)
    for y, x in rng.integers(0, (400, 500), (specks, 2)).tolist():
        labels[:, y, x] = ROAD
    with LargestTensor() as largest:
        head(labels)
    assert largest.bytes <= max(16 * labels.numel(), 8 * PAIRS_AT_ONCE)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
@presets
def test_cuda_equals_cpu(preset):
    head, batch = SSRVLAD.from_preset(preset, labels_as=SPACE), batch_of_blobs()
    expected = head.explain(batch)
    view = head.to("cuda").explain(batch.to("cuda"))
    named = {**vars(view), **view.histograms._asdict()}
    for name, value in {**vars(expected), **expected.histograms._asdict()}.items():
        if isinstance(value, torch.Tensor):
            exact = not value.is_floating_point()
            torch.testing.assert_close(named[name].cpu(), value, rtol=0, atol=0 if exact else 1e-7)


@pytest.mark.parametrize("native", [False, True])
@presets
def test_copies_narrow_heads_and_autocast_give_the_same_numbers(preset, native):
    labels = batch_of_blobs(1, 133, 201)
    head = SSRVLAD.from_preset(preset, labels_as=SPACE, working_size=None)
    head.native = head.native and native
    expected = head(labels)
    for other in (copy.deepcopy(head), pickle.loads(pickle.dumps(head)), head.half()):
        assert torch.equal(other(labels), expected)
        with torch.autocast("cpu", torch.bfloat16):
            assert torch.equal(other(labels), expected)


def test_a_custom_label_space_survives_json():
    config = dataclasses.replace(DEFAULT, labels_as=label_space(SPACE))
    again = SSRVLADConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    assert again == config
    assert SSRVLAD(again).label_space.digest == label_space(SPACE).digest
    assert torch.equal(SSRVLAD(again)(batch_of_blobs(1)), SSRVLAD(DEFAULT)(batch_of_blobs(1)))


def test_input_on_another_device_is_refused():
    head = SSRVLAD.from_preset("default").to("meta")
    with pytest.raises(ValueError, match="expected labels on meta, as the head is, got cpu"):
        head(torch.zeros(1, 4, 4, dtype=torch.uint8))


IN_CITY = dataclasses.replace(DEFAULT, labels_as="cityscapes-trainids")


@pytest.fixture(scope="module")
def city() -> torch.Tensor:
    frames = SyntheticCity(3).traverse(3)
    return torch.stack([torch.from_numpy(frame.labels) for frame in frames])


def test_the_usual_anchor_gives_the_descriptor(city):
    head = SSRVLAD(IN_CITY)
    swept = SSRVLAD(IN_CITY, (-4, 0, 4))(city)
    assert swept.shape == (3, 3, 480)
    assert torch.equal(swept[:, 1], head(city))
    assert not torch.equal(swept[:, 0], swept[:, 1])


def test_an_anchor_is_a_column_from_the_usual_one(city):
    head = SSRVLAD(IN_CITY)
    middle = SSRVLAD(dataclasses.replace(IN_CITY, anchor="middle"))
    columns = head.explain(city).histograms.column
    for number, column in enumerate(columns.tolist()):
        one = city[number : number + 1]
        assert torch.equal(middle.sweep(one, [column, column + 8]), head.sweep(one, [0, 8]))


@pytest.mark.parametrize("columns", [[], [2**62], [0.5], ["a"]])
def test_anchors_that_are_no_integers_are_refused(city, columns):
    refuses("columns: expected one or more integers", SSRVLAD(IN_CITY).sweep, city, columns)
