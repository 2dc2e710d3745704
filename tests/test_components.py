import numpy as np
import pytest
import torch
from drawings import MASKS, blobs, mask, planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.stages.bitplanes import pack, unpack
from ssrvlad_torch.stages.components import drop_regions, fill_holes


def assert_like_reference(some: torch.Tensor, area: int) -> None:
    all_filled, all_kept = unpack(fill_holes(some, area)), unpack(drop_regions(some, area))
    for b, layers in enumerate(unpack(some).numpy()):
        for k, layer in enumerate(layers):
            filled = layer | reference.small_holes(layer, area)
            np.testing.assert_array_equal(all_filled[b, k], filled)
            kept = layer & ~reference.small_regions(layer, area)
            np.testing.assert_array_equal(all_kept[b, k], kept)


@pytest.mark.parametrize("area", [0, 1, 2, 3, 5, 1000])
@pytest.mark.parametrize("name", MASKS)
def test_drawings(name, area):
    assert_like_reference(planes(mask(MASKS[name]), ~mask(MASKS[name])), area)


@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 15),
    width=st.integers(1, 15),
    area=st.integers(2, 30),
    density=st.sampled_from([0.3, 0.5, 0.65]),
)
def test_noise(seed, height, width, area, density):
    """Near the percolation threshold regions are as winding as they get."""
    layers = np.random.default_rng(seed).random((1, 8, height, width)) < density
    assert_like_reference(pack(torch.from_numpy(layers)), area)


def test_blobs_in_a_batch():
    layers = np.stack([[blobs(8 * b + k, 45, 61, 6) < 6 for k in range(8)] for b in range(2)])
    assert_like_reference(pack(torch.from_numpy(layers)), 40)


def test_an_area_of_one_pixel_changes_nothing():
    some = random_planes()
    assert fill_holes(some, 1) is some
    assert drop_regions(some, 1) is some
