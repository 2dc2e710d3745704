import numpy as np
import pytest
import torch
from drawings import BLOCK, CROSS, MASKS, mask, planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.config import CHOICES
from ssrvlad_torch.stages import skeleton
from ssrvlad_torch.stages.bitplanes import unpack
from ssrvlad_torch.stages.skeleton import RULES, zhang_suen


def thin(planes, variant):
    """The skeleton by a variant's name."""
    return skeleton.thin(planes, RULES[variant])


variants = pytest.mark.parametrize("variant", CHOICES["thinning"])


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
def test_the_input_is_left_alone(variant):
    some = random_planes(4)
    before = some.clone()
    thin(some, variant)
    assert torch.equal(some, before)


def counted_work(layer: np.ndarray) -> list[int]:
    """Words that each sub-iteration of `thin` looks at."""
    work = []

    def counting(pixels, ring):
        work.append(pixels.numel())
        return zhang_suen(pixels, ring)

    skeleton.thin(planes(layer), counting)
    return work


def test_a_settled_image_causes_no_further_sub_iterations():
    assert len(counted_work(mask(CROSS))) == 2
    assert 4 <= len(counted_work(mask(BLOCK))) <= 6


def test_work_shrinks_as_the_image_settles():
    """A small block beside a large one settles first; then nobody looks at it any more."""
    layer = np.zeros((64, 512), bool)
    layer[2:62, 2:62] = layer[20:26, 500:506] = True
    work = counted_work(layer)
    assert len(work) > 40
    assert max(work) < layer.size / 100
    assert work[-3] < work[4]


@variants
@pytest.mark.parametrize("width", [7, 8, 9, 63, 64, 65])
def test_widths_around_a_word(variant, width):
    some = random_planes(width, (2, 33, width)) | random_planes(width + 1, (2, 33, width))
    expected = [[reference.thin(x, variant) for x in layers] for layers in unpack(some).numpy()]
    np.testing.assert_array_equal(unpack(thin(some, variant)), np.array(expected))
