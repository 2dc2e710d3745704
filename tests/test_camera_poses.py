"""Cameras in space and on the ground."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ssrvlad_torch.datasets.camera_poses import (
    Y_UP_LEFT_HANDED,
    Z_DOWN,
    Z_UP,
    optical_axis,
)

EAST, NORTH, WEST = 0.0, math.pi / 2, math.pi


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3))
def test_the_axis_is_the_third_row_of_the_rotation(quaternion):
    w, x, y, z = quaternion
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(optical_axis(quaternion), rotation[2], atol=1e-9)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_what_is_no_rotation_is_refused(quaternion):
    with pytest.raises(ValueError, match="is not a rotation"):
        optical_axis(quaternion)


def test_headings_are_counted_from_x_towards_y():
    assert Z_UP.pose((1, 2, 3), (1, 0, 0)) == (1, 2, EAST)
    assert Z_UP.pose((1, 2, 3), (0, 1, 9)) == (1, 2, NORTH)
    assert Z_UP.pose((1, 2, 3), (-2, 0, 0)) == (1, 2, WEST)


def test_seen_from_above_a_left_turn_is_positive_in_every_world():
    """Ahead, and then to the left of it for someone who stands upright in that world."""
    turns = {
        Z_UP: ((1, 0, 0), (0, 1, 0)),  # x east, y north
        Z_DOWN: ((1, 0, 0), (0, -1, 0)),  # x north, y east: left of north is west
        Y_UP_LEFT_HANDED: ((0, 0, 1), (-1, 0, 0)),  # z ahead, x to the right
    }
    for ground, (ahead, left) in turns.items():
        first, second = (ground.pose((0, 0, 0), axis).heading for axis in (ahead, left))
        assert math.remainder(second - first, 2 * math.pi) == pytest.approx(math.pi / 2)
