"""Poses from ``poses.csv``, names of files, and positions of GPS."""

import csv
import math
import os

import numpy as np
import pytest
from helpers import COLOUR, png_bytes, refused, refuses
from trees import plant, write, write_placed

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.datasets.poses import (
    UNKNOWN,
    Fix,
    Pose,
    Projection,
    read_name,
    read_poses,
    write_name,
)

NAN = math.nan


@pytest.mark.parametrize(
    ("text", "poses"),
    [
        (  # columns have names
            "heading,time,y,frame,x\n0.5,7,-2,monday/001,1.25\n1,8,3e2,002,0\n",
            {"monday/001": (1.25, -2, 0.5), "002": (0, 300, 1)},
        ),
        ("frame,x,y\n1,2,3\n", {"1": (2, 3, NAN)}),
        ("frame,x,y,heading\n1,2,3,\n", {"1": (2, 3, NAN)}),
        # what spreadsheets write: a byte order mark, a space after the comma, CRLF, empty cells
        ('\ufeffframe, x, y,,\r\n"a,b", 2, 3,,, ,\r\n', {"a,b": (2, 3, NAN)}),
        ("frame,x,y,heading\n", {}),
    ],
)
def test_tables_of_poses_are_read_by_column_name(tmp_path, text, poses):
    found = read_poses(write(tmp_path / "poses.csv", text))
    assert found.keys() == poses.keys()
    for frame, pose in poses.items():
        assert found[frame] == pytest.approx(Pose(*pose), nan_ok=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'frame'"),
        ("frame,x\n1,2\n", "no column 'y'"),
        ("frame,x,y\n1,2,3\n2,east,4\n", "line 3: .*'east'"),
        ("frame,x,y\n0,inf,1\n", "line 2: expected a finite number, got inf"),
        ("frame,x,y\n0,1,1\n0,2,1\n", "line 3: frame '0' has two positions"),
        ("frame,x,y,heading\n0,1,5,2,5,0\n", "line 2: more cells than columns: 5,0"),
        ("frame,x,y,x\n0,1,1,2\n", "line 1: two columns 'x'"),
        ("frame,x,y\n0,1,nan\n", "line 2: x is 1 and y is nan; expected two numbers, or nan twice"),
        ("frame,x,y\n" + "1" * 200_000 + ",2,3\n", "field larger"),
        ("frame,x,y\nstraße,2,3\n", "utf-8"),
    ],
)
def test_damaged_files_are_refused_by_name_and_line(tmp_path, text, message):
    """The last is in another encoding; for the others the two are one."""
    path = tmp_path / "poses.csv"
    path.write_text(text, encoding="latin-1")
    with refused(message, path):
        read_poses(path)


def test_utm_fields_of_a_file_name_are_pose_and_time(tmp_path):
    published = "@0584300.52@4477100.10@17@T@40.44@-79.99@pano@3@180@@@@20210305_101500@x"
    pose, stamp = read_name(published)
    np.testing.assert_allclose(pose, [584300.52, 4477100.10, -math.pi / 2], atol=1e-9)
    assert stamp == 1614939300
    folder = plant(tmp_path / "database", f"{published}.jpg", "@home.jpg")
    known, unknown = find_image_files([folder])
    assert (known.pose, known.stamp) == (pose, stamp)
    assert math.isnan(unknown.pose.x)
    for given in (Pose(3.25, -7.5, 1.5), Pose(12, 9, math.nan)):
        again, stamp = read_name(write_name("a@b", given, 1614939300.0).removesuffix("@"))
        np.testing.assert_allclose(again, given, atol=1e-4)
        assert stamp == 1614939300
    refuses("a has no known position", write_name, "a", UNKNOWN)


def test_poses_are_written_in_both_forms(tmp_path, ssrvlad):
    folder = plant(tmp_path / "monday", "1.jpg", "2.jpg", "3.jpg")
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
    code, _, (line,) = ssrvlad("poses", plant(tmp_path / "b" / "none", "1.jpg"), "-o", table)
    assert code == 2 and "no frame has a pose" in line


EAST, NORTH = 303189.31, 5787193.03
"""Metres of 52.2 degrees north and 0.12 east in zone 31U."""


def test_latitudes_become_metres(tmp_path):
    pytest.importorskip("utm")
    path = tmp_path / "gps.csv"
    path.write_text("frame,latitude,longitude,course\na,52.2,0.12,90\nb,52.201,0.12,\n")
    first, second = read_poses(path).values()
    np.testing.assert_allclose(first, [EAST, NORTH, 0], atol=0.01)
    assert second.y - first.y == pytest.approx(111.2, abs=0.1)
    assert math.isnan(second.heading)
    path.write_text("frame,latitude,longitude\na,52.2,0.12\nb,89,5.9\nc,52.2,0.12\n")
    refuses("line 3: latitude out of range", read_poses, path)


@pytest.mark.parametrize("void", ["nan,nan", "0,0"])
def test_a_position_without_reception_is_unknown(tmp_path, void):
    pytest.importorskip("utm")
    path = write(tmp_path / "a.csv", f"frame,latitude,longitude\na,{void}\nb,52.2,0.12\n")
    unknown, known = read_poses(path).values()
    assert np.isnan(unknown).all() and known.x == pytest.approx(EAST, abs=0.01)


@pytest.mark.parametrize("places", [((51.5, -0.001), (51.5, 0.001)), ((0.001, 7), (-0.001, 7))])
def test_a_drive_may_cross_a_border_of_zones(places):
    """Of London, and the equator: 139 and 221 m."""
    pytest.importorskip("utm")
    projection = Projection()
    here, there = (projection.pose(Fix(*place)) for place in places)
    assert math.dist(here[:2], there[:2]) == pytest.approx(139 if places[0][0] > 1 else 221, abs=1)


@pytest.mark.parametrize(("west", "east"), [((51.5, -0.001), (51.5, 0.001)), ((-0.1, 7), (0.1, 7))])
def test_a_later_drive_has_the_zone_of_the_map(west, east):
    pytest.importorskip("utm")
    for first, second in ((west, east), (east, west)):
        known = Projection().pose(Fix(*first))
        later = Projection(lambda known=known: known).pose(Fix(*second))
        assert math.dist(known[:2], later[:2]) < 23_000


def test_exif_tags_give_poses_of_some_pictures(tmp_path):
    pytest.importorskip("utm")
    folder = plant(tmp_path / "photos", "2.jpg")
    write_placed(folder / "1.jpg", (52.0, 12.0, 0.0), (0.0, 7.0, 12.0))
    write_placed(folder / "6.jpg", (52.0, 12.0, 0.0), (0.0, 7.0, 12.0), status="V")
    os.mkfifo(tmp_path / "photos" / "3.png")
    bomb = png_bytes(30_000, 30_000, 8, COLOUR, b"")
    (tmp_path / "photos" / "4.png").write_bytes(bomb)
    (tmp_path / "photos" / "5.png").symlink_to("gone")
    files = find_image_files([folder, str(tmp_path / "photos" / "*.png")], poses="exif")
    expected = [[EAST, NORTH, math.pi / 2], *[UNKNOWN] * 5]
    np.testing.assert_allclose([file.pose for file in files], expected, atol=0.01)
    with pytest.raises(ValueError, match="no image of none has a position in its EXIF"):
        find_image_files([plant(tmp_path / "none", "1.jpg")], poses="exif")
