import numpy as np
import torch
from drawings import DOT, EMPTY, mask, planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.stages.bitplanes import unpack
from ssrvlad_torch.stages.centroid import centre_table, centroids


@given(seed=st.integers(0, 10_000), height=st.integers(1, 20), width=st.integers(1, 20))
def test_equal_to_the_reference(seed, height, width):
    some = random_planes(seed, (2, height, width)) & random_planes(seed + 3, (2, height, width))
    table = centre_table(centroids(some), 2)
    for b, layers in enumerate(unpack(some).numpy()):
        for k, layer in enumerate(layers):
            assert tuple(table[b, k].tolist()) == (reference.centroid(layer) or (-1, -1))


def test_a_layer_without_pixels_is_left_out():
    assert len(centroids(planes(mask(EMPTY))).group) == 0
    assert centre_table(centroids(planes(mask(DOT))), 1)[0, :2].tolist() == [[1, 2], [-1, -1]]


def test_exact_where_float32_is_not():
    wide = torch.zeros(1, 2, 9001, dtype=torch.uint8)
    wide[0, 0, 4000:] = 1
    assert centre_table(centroids(wide), 1)[0, 0].tolist() == [0, 6500]
    assert np.float32(4000 + 9000) / 2 == 6500
