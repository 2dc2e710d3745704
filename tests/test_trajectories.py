"""Poses in the forms of others: KITTI, TUM, GPS, EXIF, @UTM@ names."""

import math

import numpy as np
import pytest
from trees import plant

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.poses import UNKNOWN, Pose
from ssrvlad_torch.datasets.trajectories import Trajectory, read_trajectory


def poses(files):
    return np.array([file.pose for file in files])


def test_kitti_goes_by_the_place_of_a_frame(tmp_path):
    """The camera of KITTI looks along z and has x to its right; the second frame looks right."""
    rows = ["1 0 0 0 0 1 0 0 0 0 1 0", "0 0 1 2 0 1 0 -1.5 -1 0 0 7"]
    (tmp_path / "00.txt").write_text("\n".join(rows))
    folder = plant(tmp_path / "image_2", "000000.jpg", "000001.jpg")
    files = find_image_files([folder], poses=str(tmp_path / "00.txt"))
    np.testing.assert_allclose(poses(files), [[0, 0, math.pi / 2], [2, 7, 0]], atol=1e-12)
    only = find_image_files([folder], start=1, poses=str(tmp_path / "00.txt"))
    assert only[0].pose.y == 7, "places count before frames are left out"
    plant(tmp_path / "image_2", "000002.jpg")
    with pytest.raises(ValueError, match=r"00\.txt: expected 2 frames, one per pose, got 3"):
        find_image_files([folder], poses=str(tmp_path / "00.txt"))
    other = plant(tmp_path / "image_3", "000000.jpg")
    with pytest.raises(ValueError, match="poses of one drive, got 2 sequences"):
        find_image_files([folder, other], poses=str(tmp_path / "00.txt"))


def test_tum_goes_by_the_time_that_is_a_name(tmp_path):
    turned = math.sqrt(0.5)
    tables = {
        "groundtruth": "# timestamp tx ty tz qx qy qz qw\n"
        f"10.00 1 2 9 {-turned} 0 0 {turned}\n10.10 3 4 9 0 {turned} 0 {turned}",
        "near": "0 1 2 9 0 0 0 1\n0.01 3 4 9 0 0 0 1",
        "drive": "".join(f"{n} {n} 0 0 0 0 0 1\n" for n in range(4)),
    }
    for name, text in tables.items():
        (tmp_path / f"{name}.txt").write_text(text)

    def found(table, names, **options):
        folder = plant(tmp_path / names[0], *(f"{name}.jpg" for name in names))
        return poses(find_image_files([folder], poses=str(tmp_path / f"{table}.txt"), **options))

    expected = [[1, 2, math.pi / 2], UNKNOWN, [3, 4, 0]]
    whole = [[f"{time:0<{digits}}" for time in (10015, 10050, 10095)] for digits in (5, 8, 11)]
    for names in (["10.015", "10.050", "10.095"], *whole):
        np.testing.assert_allclose(found("groundtruth", names), expected, atol=1e-12)
    for table, names, message in (
        ("groundtruth", ["99.1"], "no pose is near"),
        ("near", ["0", "10"], "several units"),
    ):
        with pytest.raises(ValueError, match=rf"{table}.txt: {message}.* '{names[0]}'; expected"):
            found(table, names)
    seconds = found("drive", [f"{n}{'0' * 6}" for n in range(4)], largest_gap=1)[:, 0]
    assert seconds.tolist() == [0, 1, 2, 3], "in ns all are near the first pose"
    with pytest.raises(ValueError, match=r"named by their time in seconds.* 'a'"):
        found("groundtruth", ["a", "10.015"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", r"line 1: expected 12 numbers \(KITTI\) or 8 \(TUM\), got 3"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "in order of time"),
        ("1 0 0 0 0 0 0 1\n" + "0 " * 12, "in order of time"),
        ("1 0 0 0 0 0 0 0", "line 1: .* is not a rotation"),
        ("1 0 0 0 a 0 0 0", "line 1: could not convert"),
        ("# nothing", "holds no poses"),
    ],
)
def test_a_damaged_trajectory_is_named(tmp_path, text, message):
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_trajectory(tmp_path / "t.txt")


def test_a_table_that_fits_no_frame_is_refused(tmp_path):
    folder = plant(tmp_path / "monday", "1.jpg")
    (tmp_path / "other.csv").write_text("frame,x,y\n9,1,1\n")
    with pytest.raises(ValueError, match=r"other\.csv has none of the frames, .* monday/1"):
        find_image_files([folder], poses=str(tmp_path / "other.csv"))
    with pytest.raises(ValueError, match="expected a file of poses, or exif"):
        find_image_files([folder], poses="gps")


def test_poses_are_interpolated_by_time_and_the_shorter_turn():
    """The heading turns by the shorter way, and is unknown if one of the two is."""
    poses = [Pose(0, 0, 3), Pose(10, 20, -3), Pose(20, 20, math.nan), Pose(50, 20, 0)]
    trajectory = Trajectory(poses, [100, 102, 103, 110], 2)
    quarter, exact, after, gap, before = trajectory.of_frames(
        list("abcde"), [100.5, 102, 102.5, 105, 99.9]
    )
    assert quarter == pytest.approx((2.5, 5, 3 + (math.tau - 6) / 4))
    assert exact == poses[1]
    assert after[:2] == (15, 20) and math.isnan(after.heading)
    assert math.isnan(gap.x) and math.isnan(before.x)
    assert trajectory.of_frames(["100.5"]) == [quarter]
