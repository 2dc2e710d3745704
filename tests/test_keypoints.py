import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.stages.bitplanes import unpack
from ssrvlad_torch.stages.keypoints import end_points, intersections


@given(seed=st.integers(0, 10_000), height=st.integers(1, 20), width=st.integers(1, 20))
def test_any_mask(seed, height, width):
    """Keypoints are defined on any mask, thin or not."""
    some = random_planes(seed, (2, height, width)) & random_planes(seed + 7, (2, height, width))
    for fast, plain in (
        (end_points, reference.end_points),
        (intersections, reference.intersections),
    ):
        expected = [[plain(layer) for layer in layers] for layers in unpack(some).numpy()]
        np.testing.assert_array_equal(unpack(fast(some)), np.array(expected))
