import kornia.morphology
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.stages.bitplanes import unpack
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
        expected = np.stack([plain(layer, radius) for layer in layers])
        np.testing.assert_array_equal(unpack(fast(planes, radius))[0], expected)


@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 23),
    width=st.integers(1, 23),
    radii=st.tuples(st.integers(0, 5), st.integers(0, 5)),
)
def test_opening_and_closing_equal_the_reference(seed, height, width, radii):
    planes = random_planes(seed, (2, height, width)) & random_planes(seed + 1, (2, height, width))
    done = unpack(open_and_close(planes, *radii))
    assert torch.equal(unpack(open_and_close(planes, *map(torch.tensor, radii))), done)
    opening, closing = radii
    for got, layer in zip(done.flatten(0, 1), unpack(planes).flatten(0, 1).numpy(), strict=True):
        opened = reference.dilate(reference.erode(layer, opening), opening)
        closed = reference.erode(reference.dilate(opened, closing), closing)
        np.testing.assert_array_equal(got, closed)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_dilation_is_kornias(radius):
    planes = random_planes(3)
    kernel = torch.ones(2 * radius + 1, 2 * radius + 1)
    expected = kornia.morphology.dilation(unpack(planes).float(), kernel)
    assert torch.equal(unpack(dilate(planes, radius)), expected.bool())
