"""Every implementation of the descriptor against the reference: exported files also at other sizes
than the traced one."""

import numpy as np
import pytest
from conformance.descriptors import BATCHES, PROGRAMS, cases, expected, in_onnxruntime
from drawings import VOID, blobs, one_hot
from exported import PRESETS, of_preset

from ssrvlad_torch import reference
from ssrvlad_torch.soft.descriptor import SoftSSRVLAD

SLOW = {("OpenVINO", "paper"), ("compiled", "paper")}
"""Take seconds for each size; compiled by torch both presets are the same one operator."""


def each_of(names):
    """Every one of some implementations, by both presets."""
    pairs = [
        pytest.param(name, preset, marks=[pytest.mark.slow] * ((name, preset) in SLOW))
        for name in names
        for preset in PRESETS
    ]
    return pytest.mark.parametrize(("name", "preset"), pairs)


@each_of(PROGRAMS)
def test_descriptors_counts_and_skeletons_are_those_of_the_reference(name, preset, request):
    described = PROGRAMS[name](preset, [*cases().values()], request.getfixturevalue)
    for (case, right), got in zip(expected(preset).items(), described, strict=True):
        assert (got.descriptor.shape, got.descriptor.dtype) == ((480,), np.float32), case
        assert np.abs(got.descriptor - right.descriptor).max() <= 1e-6, case
        assert got.descriptor.any() == right.descriptor.any() and not got.unknown, case
        if got.keypoints is not None:
            np.testing.assert_array_equal(got.keypoints, right.keypoints, case)
        if got.skeleton is not None:
            np.testing.assert_array_equal(got.skeleton, right.skeleton, case)


@each_of(PROGRAMS)
def test_unknown_ids_are_counted(name, preset, request):
    """Where a graph counts them they belong to no layer; a program refuses the label map."""
    strange = blobs(3, 61, 83, 20) % 11
    void = strange.copy()
    strange[:9, 5:50], void[:9, 5:50] = 12, VOID
    got, other = PROGRAMS[name](preset, [strange, void], request.getfixturevalue)
    assert (got.unknown, other.unknown) == (9 * 45, 0)
    if got.descriptor is not None:
        np.testing.assert_array_equal(got.descriptor, other.descriptor)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", ["C++ over the core", "core in the browser", "ROS 2"])
def test_the_core_has_the_same_bits_everywhere(name, preset, request):
    maps = [*cases().values()]
    [here, there] = (
        PROGRAMS[program](preset, maps, request.getfixturevalue)
        for program in ("native core", name)
    )
    for one, other in zip(here, there, strict=True):
        np.testing.assert_array_equal(one.descriptor, other.descriptor)


@each_of(BATCHES)
def test_a_batch_equals_its_images(name, preset):
    batch = np.stack([blobs(seed, 133, 171, 9 + 4 * seed) for seed in range(3)])
    batch[1] = VOID
    describe = BATCHES[name](preset)
    for image, got in zip(batch, describe(batch), strict=True):
        [alone] = describe(image[None])
        np.testing.assert_array_equal(got.descriptor, alone.descriptor)
        np.testing.assert_array_equal(got.keypoints, alone.keypoints)


WIDE = {
    "stages in torch": "int64",
    "native core": "int64",
    "Python without torch": "int64",
    "C++ over ONNX Runtime": "int64",
    "C++ over the core": "int64",
}


@pytest.mark.parametrize("name", WIDE)
def test_wide_ids_give_the_same(name, request):
    maps = [labels.astype(WIDE[name]) for labels in cases().values()]
    described = PROGRAMS[name]("default", maps, request.getfixturevalue)
    for right, got in zip(expected("default").values(), described, strict=True):
        np.testing.assert_allclose(got.descriptor, right.descriptor, rtol=0, atol=1e-6)


SCORES = {
    "stages in torch": BATCHES["stages in torch"],
    "native core": BATCHES["native core"],
    "compiled": BATCHES["compiled"],
    "ONNX Runtime": lambda preset: in_onnxruntime(preset, "logits"),
}


@pytest.mark.parametrize("preset", [pytest.param("paper", marks=pytest.mark.slow), "default"])
@pytest.mark.parametrize("name", SCORES)
def test_class_scores_are_described_by_the_first_of_the_best_classes(name, preset):
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(2, 12, 61, 83)).astype(np.float32)
    scores[0] += 4 * np.eye(12, dtype=np.float32)[:, blobs(1, 61, 83, 9)]
    scores[1] = rng.integers(0, 3, (12, 61, 83))
    described = SCORES[name](preset)(scores)
    for got, labels in zip(described, scores.argmax(1), strict=True):
        right = reference.describe(labels, of_preset(preset))
        np.testing.assert_allclose(got.descriptor, right, rtol=0, atol=1e-6)


def test_the_soft_twin_is_near_the_reference():
    """Its smoothing shows where a map has a row of few pixels, and nothing is never quite zero."""
    twin, cosines = SoftSSRVLAD(of_preset("default")), []
    for name, right in expected("default").items():
        [soft] = twin(one_hot(cases()[name])).numpy()
        if right.descriptor.any():
            cosines.append(float(soft @ right.descriptor))
            assert cosines[-1] > 0.8, name
        else:
            assert np.linalg.norm(soft) < 0.1, name
    assert np.mean(cosines) > 0.98
