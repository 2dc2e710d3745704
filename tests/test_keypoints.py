import numpy as np
import torch
from graphs import run_on_planes
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import reference
from ssrvlad_torch.deployment.stages.keypoints import end_points_in_graph, intersections_in_graph
from ssrvlad_torch.stages import keypoints
from ssrvlad_torch.stages.bitplanes import unpack


def both_in_graph(graph, words):
    return [find(graph, words) for find in (end_points_in_graph, intersections_in_graph)]


def end_points(some):
    """By bit-planes and in a graph, which must agree."""
    found = keypoints.end_points(some)
    assert torch.equal(run_on_planes(both_in_graph, some)[0], found)
    return found


def intersections(some):
    """By bit-planes and in a graph, which must agree."""
    found = keypoints.intersections(some)
    assert torch.equal(run_on_planes(both_in_graph, some)[1], found)
    return found


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
