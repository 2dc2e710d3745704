import numpy as np
import pytest
import torch
from drawings import BLOCK, CROSS, MASKS, blobs, mask, planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.bitplanes import unpack
from ssrvlad_torch.config import THINNINGS
from ssrvlad_torch.stages import skeleton
from ssrvlad_torch.stages.skeleton import SUB_ITERATIONS, zhang_suen


def thin(planes, variant):
    return skeleton.thin(planes, SUB_ITERATIONS[variant])


variants = pytest.mark.parametrize("variant", THINNINGS)


@variants
@pytest.mark.parametrize("name", MASKS)
def test_drawings(name, variant):
    layer = mask(MASKS[name])
    got = unpack(thin(planes(layer, ~layer), variant))[0]
    np.testing.assert_array_equal(got[0], reference.thin(layer, variant))
    np.testing.assert_array_equal(got[1], reference.thin(~layer, variant))


@variants
def test_every_neighbourhood(variant):
    """All 512 patterns of 3 x 3 at once, one an image."""
    patterns = (np.arange(512)[:, None] >> np.arange(9) & 1).reshape(512, 3, 3)
    got = thin(torch.from_numpy(patterns).to(torch.uint8), variant)
    expected = np.stack([reference.thin(pattern.astype(bool), variant) for pattern in patterns])
    np.testing.assert_array_equal(got.bool(), expected)


@variants
@given(seed=st.integers(0, 10_000), height=st.integers(1, 24), width=st.integers(1, 24))
def test_noise(variant, seed, height, width):
    some = random_planes(seed, (1, height, width)) | random_planes(seed + 1, (1, height, width))
    expected = [reference.thin(layer, variant) for layer in unpack(some)[0].numpy()]
    np.testing.assert_array_equal(unpack(thin(some, variant))[0], np.stack(expected))


@variants
def test_blobs_in_a_batch(variant):
    layers = np.stack([blobs(seed, 51, 67, grain=11) < 5 for seed in range(4)])
    got = thin(torch.from_numpy(layers).to(torch.uint8), variant)
    expected = np.stack([reference.thin(layer, variant) for layer in layers])
    np.testing.assert_array_equal(got.bool(), expected)


@variants
def test_a_skeleton_is_its_own_skeleton(variant):
    once = thin(random_planes(9, (2, 30, 30)), variant)
    assert torch.equal(thin(once, variant), once)


@variants
def test_the_input_is_left_alone(variant):
    some = random_planes(4)
    before = some.clone()
    thin(some, variant)
    assert torch.equal(some, before)


def test_a_settled_image_causes_no_further_sub_iterations():
    calls = []

    def counted(*arguments):
        calls.append(1)
        return zhang_suen(*arguments)

    skeleton.thin(planes(mask(CROSS)), counted)
    assert len(calls) == 2
    calls.clear()
    skeleton.thin(planes(mask(BLOCK)), counted)
    assert 2 < len(calls) <= 6
