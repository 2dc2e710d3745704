"""Poses as data sets store them: GPS fixes, quaternions and matrices of cameras in space."""

import json
import math

import numpy as np
import pytest
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from layout_copies import write
from scipy.spatial.transform import Rotation

from ssrvlad_torch.datasets.camera_poses import (
    Y_UP_LEFT_HANDED,
    Z_DOWN,
    Z_UP,
    optical_axis,
    read_cmu_list,
    read_fix,
    read_matrix,
    read_nvm,
    read_v2_poses,
)

EAST, NORTH = 0.0, math.pi / 2
LEVEL = "0.5 -0.5 -0.5 -0.5"
"""From world to camera, of a level camera that looks along +x of a world with z down."""
README = (
    "img_00122_c0_1303398475046031us.jpg 0.636779 0.569692 0.379586 -0.354792 "
    "-85.392177 55.210379 -2.980700"
)
"""The line of slice 2 that the README of Extended CMU Seasons shows."""


def nvm(*cameras, header="NVM_V3 "):
    return [header, "", str(len(cameras)), *cameras, "", "1", "1.5 2.5 3.5 10 20 30 1 0 4 5.5 6.5"]


def camera(name, x, y, quaternion=LEVEL):
    return f"{name} 400.000000 {quaternion} {x} {y} -2.5 0 0"


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3))
def test_the_axis_is_the_third_row_of_the_rotation(quaternion):
    w, x, y, z = quaternion
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(optical_axis(quaternion), rotation[2], atol=1e-9)


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


def fix(tmp_path, latitude, longitude, **others):
    content = {"gpsLatitude": latitude, "gpsLongitude": longitude, **others}
    return read_fix(write(tmp_path / "a_vehicle.json", json.dumps(content)))


def test_on_the_meridian_north_is_y(tmp_path):
    """A degree of a circle around a sphere of 6371 km is 111.195 km."""
    x, y, heading = fix(tmp_path, 50, 9)
    assert (x, y) == pytest.approx((0, 50 * 111_194.93), abs=1)
    assert math.isnan(heading), "a course may be left out"
    assert fix(tmp_path, 0, 10)[0] == pytest.approx(111_194.93, rel=1e-3)


@pytest.mark.parametrize(
    ("course", "heading"), [(0, NORTH), (90, EAST), (180, -math.pi / 2), (281, math.radians(169))]
)
def test_courses_become_headings(tmp_path, course, heading):
    assert fix(tmp_path, 50, 9, gpsHeading=course).heading == pytest.approx(heading)


@pytest.mark.parametrize(
    ("yaw", "heading"),
    [(0, NORTH), (math.pi / 2, EAST), (math.pi, -math.pi / 2), (-math.pi / 4, 3 * math.pi / 4)],
)
def test_headings_of_synthia_count_from_x_towards_y(tmp_path, yaw, heading):
    """Yaw 0 looks along the world's z, which is a `Pose`'s y; a quarter turn clockwise, along x.
    The columns of the matrix are right, up, back and the position."""
    right = (math.cos(yaw), 0, -math.sin(yaw))
    back = (-math.sin(yaw), 0, -math.cos(yaw))
    numbers = (*right, 0, 0, 1, 0, 0, *back, 0, 3, 1, -4, 1)
    pose = read_matrix(write(tmp_path / "0.txt", " ".join(map(str, numbers))))
    assert pose == pytest.approx((3, -4, heading))


def test_the_pose_of_robotcars_readme_equals_that_by_hand(tmp_path):
    """The README's estimate for rear/1417178853389469.jpg: by hand, the third row of its rotation
    is (0.884, -0.425, 0.192) and the second, which is down, (-0.170, 0.090, 0.981)."""
    quaternion = "0.655230866337965 -0.536609290501044 -0.340346549997501 -0.408516459863989"
    line = camera("sun/rear/1417178853389469.jpg", 1, 2, quaternion)
    pose = read_nvm(write(tmp_path / "all.nvm", nvm(line)))["sun/rear/1417178853389469"]
    assert pose == pytest.approx((2, 1, math.atan2(0.88446, -0.42513)), abs=1e-4)


def test_the_pose_of_extended_cmus_readme_equals_that_by_hand(tmp_path):
    """By hand: the third row of the rotation is (-0.888, 0.456, 0.063) and the second, which is
    down, (-0.019, 0.099, -0.995): so z is up, and the camera looks west by north."""
    poses = read_cmu_list(write(tmp_path / "poses.txt", [README]))
    x, y, heading = poses["img_00122_c0_1303398475046031us"]
    assert (x, y) == (-85.392177, 55.210379)
    assert heading == pytest.approx(math.atan2(0.4562, -0.8877), abs=1e-3)


@pytest.mark.parametrize("number", range(3))
def test_both_forms_of_a_pose_are_one_pose(tmp_path, number):
    rotation = Rotation.random(rng=np.random.default_rng(number))
    x, y, z, w = rotation.as_quat()
    centre = np.random.default_rng(number).normal(size=3) * 100
    line = " ".join(map(str, ("rain/rear/1.png", 400, w, x, y, z, *centre, 0, 0)))
    inverse = np.column_stack((rotation.as_matrix().T, centre))
    lines = [" ".join(map(str, ("rain/rear/1.png", *inverse.ravel(), 0, 0, 0, 1)))]
    first = read_nvm(write(tmp_path / "all.nvm", nvm(line)))
    second = read_v2_poses(write(tmp_path / "train.txt", lines))
    assert first["rain/rear/1"] == pytest.approx(second["rain/rear/1"])


FIX = "must hold numbers gpsLatitude"
LIST = ["# name qw qx qy qz cx cy cz", README]
V2 = ["b.png 0 0 1 1 1 0 0 2 0 1 0 -2.5 0 0 0 1"]
DAMAGED = [
    (read_fix, "[1, 2]", FIX),
    (read_fix, '{"gpsLatitude": "50", "gpsLongitude": 9}', FIX),
    (read_fix, '{"gpsLatitude": 50, "gpsLongitude": 9, "gpsHeading": Infinity}', FIX),
    (read_matrix, "", "expected 16 numbers, got 0"),
    (read_matrix, "1 " * 15 + "x", "'x'"),
    (read_nvm, ["ply"], "is not an NVM_V3 model"),
    (read_nvm, ["NVM_V3"], "line 1: .*'no number of cameras'"),
    (read_nvm, ["NVM_V3", "", "many"], "line 3: .*'many'"),
    (read_nvm, ["NVM_V3", "", "2", camera("a", 1, 2)], "ends 1 cameras too early"),
    (read_nvm, ["NVM_V3", "", "1", "a 400 1 0 0 0 1 2"], "line 4: expected 10 numbers, got 7"),
    (read_nvm, ["NVM_V3", "", "1", camera("a", 1, 2, "0 0 0 0")], "line 4: .* is not a rotation"),
    (read_v2_poses, [*V2, "a.png 1 2 3"], "line 2: expected 16 numbers, got 3"),
    (read_cmu_list, [*LIST, "a.jpg 1 0 0 0 1 2 3 4"], "line 3: expected 7 numbers, got 8"),
    (read_cmu_list, [*LIST, "a.jpg 0 0 0 0 1 2 3"], "line 3: .* is not a rotation"),
]


@pytest.mark.parametrize(("read", "lines", "message"), DAMAGED)
def test_damaged_poses_are_refused_by_file_and_line(tmp_path, read, lines, message):
    path = write(tmp_path / "poses", lines)
    with refused(message, path):
        read(path)
