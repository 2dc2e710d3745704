"""Poses of names of files, EXIF tags and positions of GPS, and their conversion."""

import csv
import math
import os

import numpy as np
import pytest
from helpers import COLOUR, png_bytes, refuses
from layout_copies import plant, write, write_placed

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.pose_tables import read_poses
from ssrvlad_torch.datasets.poses import UNKNOWN, Fix, Pose, Projection, read_name, write_name

needs_gps = pytest.mark.usefixtures("utm")


@pytest.fixture(scope="module")
def utm():
    return pytest.importorskip("utm", reason="needs the extra gps")


def test_utm_fields_of_a_file_name_are_pose_and_time(tmp_path):
    published = "@0584300.52@4477100.10@17@T@40.44@-79.99@pano@3@180@@@@20210305_101500@x"
    pose, stamp = read_name(published)
    np.testing.assert_allclose(pose, [584300.52, 4477100.10, -math.pi / 2], atol=1e-9)
    assert stamp == 1614939300
    folder = plant(tmp_path / "database", f"{published}.jpg", "@home.jpg")
    with_fields, without = find_image_files([folder])
    assert (with_fields.pose, with_fields.stamp) == (pose, stamp)
    assert math.isnan(without.pose.x)
    notes = []
    plant(folder, f"{published.replace('@17@', '@18@')}.jpg")
    assert len(find_image_files([folder], note=notes.append)) == 3
    assert "UTM zones 17, 18; expected one" in notes[0]


@pytest.mark.parametrize("pose", [Pose(3.25, -7.5, 1.5), Pose(12, 9, math.nan)])
def test_a_written_name_is_read_again(pose):
    again, stamp = read_name(write_name("a@b", pose, 1614939300.0).removesuffix("@"))
    np.testing.assert_allclose(again, pose, atol=1e-4)
    assert stamp == 1614939300


def test_poses_are_written_in_both_forms(tmp_path, ssrvlad):
    folder = plant(tmp_path / "monday", "1.jpg", "2.jpg", "3.jpg")
    (tmp_path / "poses.csv").write_text("frame,x,y,heading\n1,5,6,0.5\nmonday/3,7,8,\n")
    pictures, table = tmp_path / "utm", tmp_path / "out.csv"
    assert "2 of 3 frames have a pose" in ssrvlad("poses", folder, "-o", pictures)[1]
    assert len(list(pictures.glob("@*@.jpg"))) == 2
    ssrvlad("poses", pictures, "-o", table)
    assert [[float(row[c]) for c in "xy"] for row in csv.DictReader(table.open())] == [
        [5, 6],
        [7, 8],
    ]
    code, _, (line,) = ssrvlad("poses", plant(tmp_path / "b" / "none", "1.jpg"), "-o", table)
    assert code == 2 and "no frame has a pose" in line


EAST, NORTH = 303189.31, 5787193.03
"""Metres of 52.2 degrees north and 0.12 east in zone 31U."""


@needs_gps
def test_latitudes_become_metres(tmp_path):
    rows = "a,52.2,0.12,90\nb,52.201,0.12,\nnone,nan,nan,\nvoid,0,0,\n"
    path = write(tmp_path / "gps.csv", f"frame,latitude,longitude,course\n{rows}")
    first, second, *unknown = read_poses(path).values()
    np.testing.assert_allclose(first, [EAST, NORTH, 0], atol=0.01)
    assert second.y - first.y == pytest.approx(111.2, abs=0.1)
    assert math.isnan(second.heading) and np.isnan(unknown).all()
    path.write_text("frame,latitude,longitude\na,52.2,0.12\nb,89,5.9\nc,52.2,0.12\n")
    refuses("line 3: latitude 89.0 out of range", read_poses, path)


@needs_gps
@pytest.mark.parametrize(("west", "east"), [((51.5, -0.001), (51.5, 0.001)), ((-0.1, 7), (0.1, 7))])
def test_a_later_sequence_has_the_zone_of_the_map(west, east):
    for first, second in ((west, east), (east, west)):
        (of_map,) = Projection().poses([Fix(*first)])
        (later,) = Projection(lambda of_map=of_map: of_map).poses([Fix(*second)])
        assert math.dist(of_map[:2], later[:2]) < 23_000


@needs_gps
def test_a_wrong_first_position_does_not_choose_the_zone():
    right = [Fix(52.2, 6.1, 90)] * 3
    assert Projection().poses([Fix(0.1, 30, 0), *right])[1:] == Projection().poses(right)


@needs_gps
@pytest.mark.parametrize(
    ("latitude", "longitude", "letters"),
    [
        ((52, 12, 0), (0, 7, 12), "ne"),
        ((52, 12, 0), (0, 7, 12), "EN"),
        ((52, 61, 0), (0, 7, 12), "NE"),
        ((52, 12, 0), (181, 0, 0), "NW"),
        ((91, 0, 0), (0, 7, 12), "SE"),
        ((0, 0, 0), (0, 0, 0), "NE"),
    ],
)
def test_a_position_in_exif_that_is_none_is_unknown(tmp_path, latitude, longitude, letters):
    write_placed(tmp_path / "1.jpg", latitude, longitude, letters=letters)
    refuses("no image of .* has a position", find_image_files, [tmp_path], poses="exif")


@needs_gps
def test_exif_tags_give_poses_of_some_pictures(tmp_path):
    """Others have none, a void position, or are no pictures."""
    folder = plant(tmp_path / "photos", "2.jpg")
    write_placed(folder / "1.jpg", (52.0, 12.0, 0.0), (0.0, 7.0, 12.0))
    write_placed(folder / "6.jpg", (52.0, 12.0, 0.0), (0.0, 7.0, 12.0), status="V")
    os.mkfifo(folder / "3.png")
    (folder / "4.png").write_bytes(png_bytes(30_000, 30_000, 8, COLOUR, b""))
    (folder / "5.png").symlink_to("gone")
    files = find_image_files([folder, str(folder / "*.png")], poses="exif")
    expected = [[EAST, NORTH, math.pi / 2], *[UNKNOWN] * 5]
    np.testing.assert_allclose([file.pose for file in files], expected, atol=0.01)
    with pytest.raises(ValueError, match="no image of none has a position in its EXIF"):
        find_image_files([plant(tmp_path / "none", "1.jpg")], poses="exif")
