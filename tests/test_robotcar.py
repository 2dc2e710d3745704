"""The layout of RobotCar Seasons."""

import math

import numpy as np
import pytest
from helpers import refused
from scipy.spatial.transform import Rotation
from trees import outline, plant, roles, write

from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.datasets.robotcar import read_nvm, read_v2_poses

NORTHWARD = "0.5 -0.5 -0.5 -0.5"
"""From world to camera, of a level camera that looks along +x of a world with z down: the rows of
the rotation are (0, 1, 0), (0, 0, 1) and (1, 0, 0)."""

TIMES = (1417176458999821, 1417176459082965)


def nvm(*cameras, header="NVM_V3 "):
    return [header, "", str(len(cameras)), *cameras, "", "1", "1.5 2.5 3.5 10 20 30 1 0 4 5.5 6.5"]


def camera(name, x, y, quaternion=NORTHWARD):
    return f"{name} 400.000000 {quaternion} {x} {y} -2.5 0 0"


def matrix(name, x, y):
    """The same camera as a line of version 2: columns right, down, ahead and the centre."""
    return f"{name} 0 0 1 {x} 1 0 0 {y} 0 1 0 -2.5 0 0 0 1"


@pytest.fixture
def tree(tmp_path):
    """As it is unpacked; the models were built from PNGs."""
    root = tmp_path / "RobotCar-Seasons"
    plant(
        root / "images",
        *(
            f"overcast-reference/{side}/{t}.jpg"
            for side in ("left", "rear", "right")
            for t in TIMES
        ),
        "dawn/rear/1418721355795420.jpg",
        "dawn/rear/1418721356878649.jpg",
        "night-rain/rear/1418840450664292.jpg",
    )
    write(
        root / "3D-models" / "all-merged" / "all.nvm",
        nvm(
            camera(f"./overcast-reference/rear/{TIMES[0]}.png", 100, 20),
            camera(f"overcast-reference/rear/{TIMES[1]}.png", 101, 20),
            camera(f"overcast-reference/left/{TIMES[0]}.png", 100.5, 20),
        ),
    )
    write(root / "robotcar_v2_train.txt", [matrix("dawn/rear/1418721355795420.png", 103, 21)])
    write(root / "intrinsics" / "rear_intrinsics.txt", "fx 400.0\n")
    return root


def test_a_traverse_is_a_camera_in_a_condition(tree):
    dataset = open_dataset(tree)
    assert dataset.layout == "robotcar-seasons"
    assert roles(dataset) == {
        "dawn-rear": "query",
        "night-rain-rear": "query",
        "overcast-reference-left": "reference",
        "overcast-reference-rear": "reference",
        "overcast-reference-right": "reference",
    }
    assert outline(dataset)["overcast-reference-rear"] == [str(time) for time in TIMES]
    assert dataset.truth.metres == 5
    rear = dataset.select(["*-rear"])
    assert [len(list(rear.select(role=role).frames)) for role in ("query", "reference")] == [3, 2]


def test_poses_come_from_the_model_and_from_version_2(tree):
    """x of a `Pose` is the world's second axis: east, if its first is north."""
    poses = {frame.frame: frame.pose for frame in open_dataset(tree).frames}
    reference = poses[f"overcast-reference-rear/{TIMES[0]}"]
    assert reference == pytest.approx((20, 100, math.pi / 2))
    assert poses["dawn-rear/1418721355795420"] == pytest.approx((21, 103, math.pi / 2))
    assert math.isnan(poses["dawn-rear/1418721356878649"].x)


def test_what_is_missing_is_said(tree):
    where = "it is at visuallocalization.net/datasets (RobotCar Seasons)"
    assert open_dataset(tree).warnings == [
        "5 of 9 frames have no pose, the first is dawn-rear/1418721356878649"
    ]
    (tree / "robotcar_v2_train.txt").unlink()
    (tree / "3D-models" / "all-merged" / "all.nvm").unlink()
    assert open_dataset(tree).warnings == [
        f"{tree} has no 3D-models/**/*.nvm, so overcast-reference has no poses; {where}",
        f"{tree} has no robotcar_v2_train.txt, so no query has a pose; {where}",
    ]


def test_models_of_single_places_do_as_well(tree):
    whole = tree / "3D-models" / "all-merged" / "all.nvm"
    lines = whole.read_text().splitlines()
    whole.unlink()
    for number in (1, 2, 3):
        model = nvm(lines[2 + number])
        write(tree / "3D-models" / "individual" / "nvm" / f"00{number}_aligned.nvm", model)
    assert len(list(open_dataset(tree).posed().frames)) == 4


def test_packed_conditions_are_named(tmp_path):
    for name in ("dawn.zip", "rain.zip"):
        write(tmp_path / "images" / name, "")
    with pytest.raises(ValueError, match=r"unpacked; found images/dawn\.zip, images/rain\.zip; "):
        open_dataset(tmp_path, "robotcar-seasons")


# ---- poses


def test_the_example_of_the_data_set(tmp_path):
    """The README's estimate for rear/1417178853389469.jpg: by hand, the third row of its rotation
    is (0.884, -0.425, 0.192) and the second, which is down, (-0.170, 0.090, 0.981)."""
    quaternion = "0.655230866337965 -0.536609290501044 -0.340346549997501 -0.408516459863989"
    line = camera("sun/rear/1417178853389469.jpg", 1, 2, quaternion)
    pose = read_nvm(write(tmp_path / "all.nvm", nvm(line)))["sun/rear/1417178853389469"]
    assert pose == pytest.approx((2, 1, math.atan2(0.88446, -0.42513)), abs=1e-4)


def test_both_forms_of_a_pose_are_one_pose(tmp_path):
    for number in range(20):
        rotation = Rotation.random(rng=np.random.default_rng(number))
        x, y, z, w = rotation.as_quat()
        centre = np.random.default_rng(number).normal(size=3) * 100
        name = "rain/rear/1.png"
        line = " ".join(map(str, (name, 400, w, x, y, z, *centre, 0, 0)))
        inverse = np.column_stack((rotation.as_matrix().T, centre))
        numbers = [*inverse.ravel(), 0, 0, 0, 1]
        first = read_nvm(write(tmp_path / "all.nvm", nvm(line)))
        lines = [" ".join(map(str, (name, *numbers)))]
        second = read_v2_poses(write(tmp_path / "train.txt", lines))
        assert first["rain/rear/1"] == pytest.approx(second["rain/rear/1"])


def test_the_header_may_hold_a_calibration_and_the_points_are_not_read(tmp_path):
    model = nvm(camera("a/rear/1.png", 1, 2), header="NVM_V3 FixedK 400 508 400 498 0")
    path = write(tmp_path / "all.nvm", [*model, "these are no points"])
    assert list(read_nvm(path)) == ["a/rear/1"]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["ply"], "is not an NVM_V3 model"),
        ([], "is not an NVM_V3 model"),
        (["NVM_V3"], "holds no number of cameras"),
        (["NVM_V3", "", "many"], "line 3: .*'many'"),
        (["NVM_V3", "", "2", camera("a", 1, 2)], "line 4: the file ends 1 cameras too early"),
        (["NVM_V3", "", "1", "a 400 1 0 0 0 1 2"], "line 4: expected 10 numbers, got 7"),
        (["NVM_V3", "", "1", camera("a", "x", 2)], "line 4: .*'x'"),
        (["NVM_V3", "", "1", camera("a", 1, 2, "0 0 0 0")], "line 4: .* is not a rotation"),
    ],
)
def test_damaged_models_are_refused_by_file_and_line(tmp_path, lines, message):
    path = write(tmp_path / "all.nvm", lines)
    with refused(message, path):
        read_nvm(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.png 1 2 3", "line 2: expected 16 numbers, got 3"),
        ("a.png " + "x " * 16, "line 2: .*'x'"),
    ],
)
def test_damaged_poses_of_version_2_are_refused(tmp_path, line, message):
    path = write(tmp_path / "train.txt", [matrix("b.png", 1, 2), line])
    with refused(message, path):
        read_v2_poses(path)
