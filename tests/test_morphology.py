import kornia.morphology
import numpy as np
import pytest
import torch
from drawings import MASKS, mask
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.bitplanes import unpack
from ssrvlad_torch.stages.morphology import dilate, erode, open_and_close


@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 23),
    width=st.integers(1, 23),
    radius=st.integers(0, 7),
)
def test_equal_to_the_reference_on_every_layer(seed, height, width, radius):
    planes = random_planes(seed, (1, height, width))
    layers = unpack(planes)[0].numpy()
    for fast, plain in ((dilate, reference.dilate), (erode, reference.erode)):
        expected = np.stack([plain(layer, reference.square(radius)) for layer in layers])
        np.testing.assert_array_equal(unpack(fast(planes, radius))[0], expected)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_dilation_is_kornias(radius):
    planes = random_planes(3)
    kernel = torch.ones(2 * radius + 1, 2 * radius + 1)
    expected = kornia.morphology.dilation(unpack(planes).float(), kernel)
    assert torch.equal(unpack(dilate(planes, radius)), expected.bool())


def test_closing_adds_and_opening_removes():
    planes = random_planes(5)
    assert torch.equal(open_and_close(planes, 0, 2) & planes, planes)
    assert torch.equal(open_and_close(planes, 1, 0) | planes, planes)


def test_radius_zero_is_the_same_tensor():
    planes = random_planes(6)
    assert torch.equal(open_and_close(planes, 0, 0), planes)


def test_a_radius_beyond_the_image():
    planes = torch.tensor([[[1, 0], [0, 0]]], dtype=torch.uint8)
    assert (dilate(planes, 50) == 1).all()
    assert (erode(planes, 50) == 0).all()


@pytest.mark.parametrize("name", MASKS)
def test_order_is_opening_then_closing(name):
    layer = mask(MASKS[name])
    element = reference.square(1)
    opened = reference.dilate(reference.erode(layer, element), element)
    expected = reference.erode(reference.dilate(opened, element), element)
    planes = torch.from_numpy(layer.astype(np.uint8))[None]
    np.testing.assert_array_equal(open_and_close(planes, 1, 1)[0].bool(), expected)
