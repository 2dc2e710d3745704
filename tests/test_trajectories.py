"""Poses in the forms of others: KITTI, TUM, GPS, EXIF, @UTM@ names."""

import csv
import math
import os

import numpy as np
import pytest
from PIL import ExifTags, Image

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.poses import UNKNOWN, Pose, read_name, read_poses, write_name
from ssrvlad_torch.datasets.trajectories import read_trajectory

CAMBRIDGE = (52.2, 0.12)
EAST, NORTH = 303189.31, 5787193.03
"""Of CAMBRIDGE in zone 31U."""


def pictures(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("RGB", (8, 6)).save(folder / f"{name}.jpg")
    return str(folder)


def poses(files):
    return np.array([file.pose for file in files])


def test_kitti_goes_by_the_place_of_a_frame(tmp_path):
    """The camera of KITTI looks along z and has x to its right; the second frame looks right."""
    rows = ["1 0 0 0 0 1 0 0 0 0 1 0", "0 0 1 2 0 1 0 -1.5 -1 0 0 7"]
    (tmp_path / "00.txt").write_text("\n".join(rows))
    folder = pictures(tmp_path / "image_2", ["000000", "000001"])
    files = find_image_files([folder], poses=str(tmp_path / "00.txt"))
    np.testing.assert_allclose(poses(files), [[0, 0, math.pi / 2], [2, 7, 0]], atol=1e-12)
    only = find_image_files([folder], start=1, poses=str(tmp_path / "00.txt"))
    assert only[0].pose.y == 7, "places count before frames are left out"
    pictures(tmp_path / "image_2", ["000002"])
    with pytest.raises(ValueError, match=r"00\.txt: expected 2 frames, one per pose, got 3"):
        find_image_files([folder], poses=str(tmp_path / "00.txt"))
    other = pictures(tmp_path / "image_3", ["000000"])
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
        folder = pictures(tmp_path / names[0], names)
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


def test_latitudes_become_metres(tmp_path):
    pytest.importorskip("utm")
    path = tmp_path / "gps.csv"
    path.write_text("frame,latitude,longitude,course\na,52.2,0.12,90\nb,52.201,0.12,\n")
    first, second = read_poses(path).values()
    np.testing.assert_allclose(first, [EAST, NORTH, 0], atol=0.01)
    assert second.y - first.y == pytest.approx(111.2, abs=0.1)
    assert math.isnan(second.heading)
    for places in ("a,52.2,5.9\nb,52.2,6.1", "a,52.2,5.99", "a,0.005,7"):
        path.write_text(f"frame,latitude,longitude\n{places}\n")
        with pytest.raises(ValueError, match="within 1 km of the border of a UTM zone"):
            read_poses(path)
    path.write_text("frame,latitude,longitude\na,89,5.9\n")
    with pytest.raises(ValueError, match="latitude out of range"):
        read_poses(path)


def test_exif(tmp_path):
    pytest.importorskip("utm")
    folder = pictures(tmp_path / "photos", ["1", "2"])
    tag, exif = ExifTags.GPS, Image.Exif()
    exif.get_ifd(ExifTags.IFD.GPSInfo).update({
        tag.GPSLatitudeRef: "N", tag.GPSLatitude: (52.0, 12.0, 0.0),
        tag.GPSLongitudeRef: "E", tag.GPSLongitude: (0.0, 7.0, 12.0),
        tag.GPSImgDirectionRef: "T", tag.GPSImgDirection: 0.0,
    })  # fmt: skip
    Image.new("RGB", (8, 6)).save(tmp_path / "photos" / "1.jpg", exif=exif)
    os.mkfifo(tmp_path / "photos" / "3.png")
    files = find_image_files([folder, str(tmp_path / "photos" / "*.png")], poses="exif")
    expected = [[EAST, NORTH, math.pi / 2], UNKNOWN, UNKNOWN]
    np.testing.assert_allclose(poses(files), expected, atol=0.01)
    with pytest.raises(ValueError, match="no image of none has a position in its EXIF"):
        find_image_files([pictures(tmp_path / "none", ["1"])], poses="exif")


def test_names_with_utm_fields(tmp_path):
    published = "@0584300.52@4477100.10@17@T@40.44@-79.99@pano@3@180@@@@20210305_101500@x"
    pose, stamp = read_name(published)
    np.testing.assert_allclose(pose, [584300.52, 4477100.10, -math.pi / 2], atol=1e-9)
    assert stamp == 1614939300
    folder = pictures(tmp_path / "database", [published, "@home"])
    known, unknown = find_image_files([folder])
    assert (known.pose, known.stamp) == (pose, stamp)
    assert math.isnan(unknown.pose.x)
    for given in (Pose(3.25, -7.5, 1.5), Pose(12, 9, math.nan)):
        again, stamp = read_name(write_name("a@b", given, 1614939300.0).removesuffix("@"))
        np.testing.assert_allclose(again, given, atol=1e-4)
        assert stamp == 1614939300
    with pytest.raises(ValueError, match="a has no known position"):
        write_name("a", UNKNOWN)


def test_poses_are_written_in_both_forms(tmp_path, ssrvlad):
    folder = pictures(tmp_path / "monday", ["1", "2", "3"])
    (tmp_path / "poses.csv").write_text("frame,x,y,heading\n1,5,6,0.5\nmonday/3,7,8,\n")
    named = tmp_path / "utm"
    assert "2 of 3 frames have a pose" in ssrvlad("poses", folder, "-o", named)[1]
    assert len(list(named.glob("@*@.jpg"))) == 2
    table = tmp_path / "out.csv"
    ssrvlad("poses", named, "-o", table)
    found = [[float(row[c]) for c in "xy"] for row in csv.DictReader(table.open())]
    assert found == [[5, 6], [7, 8]]
    stack = tmp_path / "stack.npy"
    np.save(stack, np.zeros((2, 6, 8, 3), np.uint8))
    (tmp_path / "poses.csv").write_text("frame,x,y\nstack-000001,5,6\n")
    assert ssrvlad("poses", stack, "-o", tmp_path / "more")[0] == 0
    assert len(list((tmp_path / "more").glob("*.png"))) == 1
    code, _, (line,) = ssrvlad("poses", pictures(tmp_path / "b" / "none", ["1"]), "-o", table)
    assert code == 2 and "no frame has a pose" in line


def test_a_table_that_fits_no_frame_is_refused(tmp_path):
    folder = pictures(tmp_path / "monday", ["1"])
    (tmp_path / "other.csv").write_text("frame,x,y\n9,1,1\n")
    with pytest.raises(ValueError, match=r"other\.csv has none of the frames, .* monday/1"):
        find_image_files([folder], poses=str(tmp_path / "other.csv"))
    with pytest.raises(ValueError, match="expected a file of poses, or exif"):
        find_image_files([folder], poses="gps")
