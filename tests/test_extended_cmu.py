"""The layout of Extended CMU Seasons."""

import math
import time

import pytest
from helpers import refused
from trees import outline, plant, roles, write

from ssrvlad_torch.datasets.extended_cmu import read_list
from ssrvlad_torch.datasets.layouts import open_dataset

README = (
    "img_00122_c0_1303398475046031us.jpg 0.636779 0.569692 0.379586 -0.354792 "
    "-85.392177 55.210379 -2.980700"
)
"""The line of slice 2 that the README of the data set shows."""

MAP, AUTUMN, OCTOBER = 1303398475046031, 1285948800000000, 1287446410000000
"""Microseconds of 2011-04-21 at 15:07, 2010-10-01 at 16:00 and 2010-10-19 at 00:00 (UTC)."""

LEVEL_NORTH = "0.5 0.5 -0.5 0.5"
"""A level camera that looks along +x of a world with z up."""


def image(number, camera, time):
    return f"img_{number:05d}_c{camera}_{time}us.jpg"


def pose(name, quaternion, x, y, z=1.5):
    return f"{name} {quaternion} {x} {y} {z}"


@pytest.fixture
def tree(tmp_path):
    """Slices 6 and 7 as their archives unpack; half of the query images have poses."""
    root = tmp_path / "Extended-CMU-Seasons"
    write(root / "intrinsics.txt", "c0 OPENCV 1024 768 868.99 866.06 525.94 420.04\n")
    reference = [image(n, c, MAP + n) for n in (99, 100, 101) for c in (0, 1)]
    queries = [image(n, 0, AUTUMN + n) for n in (9, 10, 11)] + [image(5, 0, OCTOBER)]
    plant(root / "slice7" / "database", *reference)
    plant(root / "slice7" / "query", *queries)
    plant(root / "slice6" / "database", image(7, 0, MAP))
    plant(root / "slice6" / "query", image(8, 1, OCTOBER))
    write(
        root / "slice7" / "ground-truth-database-images-slice7.txt",
        [pose(name, LEVEL_NORTH, n, 2 * n) for n, name in enumerate(reference)],
    )
    write(root / "slice7" / "test-images-slice7.txt", queries)
    write(root / "slice7" / "camera-poses" / "a.txt", [pose(queries[0], LEVEL_NORTH, 7, 8)])
    write(root / "slice7" / "camera-poses" / "b.txt", ["", pose(queries[3], LEVEL_NORTH, 5, 6)])
    write(root / "slice7" / "camera-poses" / "empty.txt", "")
    write(root / "slice6" / "ground-truth-database-images-slice6.txt", [])
    (root / "slice7" / "sparse").mkdir()
    return root


def test_a_traverse_is_a_camera_on_a_day(tree):
    dataset = open_dataset(tree)
    assert dataset.layout == "extended-cmu"
    assert roles(dataset) == {
        "slice6-c0-2011-04-21": "reference",
        "slice6-c1-2010-10-19": "query",
        "slice7-c0-2011-04-21": "reference",
        "slice7-c1-2011-04-21": "reference",
        "slice7-c0-2010-10-01": "query",
        "slice7-c0-2010-10-19": "query",
    }
    frames = outline(dataset)
    assert frames["slice7-c0-2010-10-01"] == [image(n, 0, AUTUMN + n)[:-4] for n in (9, 10, 11)]
    assert [name[:9] for name in frames["slice7-c1-2011-04-21"]] == [
        "img_00099",
        "img_00100",
        "img_00101",
    ]
    assert dataset.truth.metres == 5


@pytest.mark.parametrize("zone", ["America/Los_Angeles", "Asia/Tokyo"])
def test_the_day_is_the_same_wherever_it_is_read(tree, monkeypatch, zone):
    names = list(outline(open_dataset(tree)))
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        assert list(outline(open_dataset(tree))) == names
    finally:
        monkeypatch.undo()
        time.tzset()


def test_poses_are_joined_by_name(tree):
    frames = {frame.frame: frame.pose for frame in open_dataset(tree).frames}
    reference = f"slice7-c1-2011-04-21/{image(100, 1, MAP + 100)[:-4]}"
    assert frames[reference] == pytest.approx((3, 6, 0), abs=1e-12)
    query = f"slice7-c0-2010-10-01/{image(9, 0, AUTUMN + 9)[:-4]}"
    assert frames[query] == pytest.approx((7, 8, 0), abs=1e-12)
    without = f"slice7-c0-2010-10-01/{image(10, 0, AUTUMN + 10)[:-4]}"
    assert all(map(math.isnan, frames[without]))


def test_what_is_missing_is_said(tree):
    dataset = open_dataset(tree)
    where = "they are at visuallocalization.net/datasets (Extended CMU Seasons, slice*.tar)"
    assert dataset.warnings[:2] == [
        f"{tree / 'slice6' / part} has no poses; {where}" for part in ("database", "query")
    ]
    assert dataset.warnings[2].startswith("4 of 12 frames have no pose, the first is slice6-c0-")
    assert len(list(dataset.posed().frames)) == 8


def test_one_slice_is_a_data_set_too(tree, monkeypatch):
    names = [name for name in outline(open_dataset(tree)) if name.startswith("slice7")]
    assert list(outline(open_dataset(tree / "slice7"))) == names
    monkeypatch.chdir(tree / "slice7" / "database")
    assert list(outline(open_dataset(".."))) == names


def test_undistorted_copies_have_the_poses_of_their_originals(tmp_path):
    plant(tmp_path / "slice2" / "database", "img_00122_c0_1303398475046031us_rect.png")
    write(tmp_path / "slice2" / "ground-truth-database-images-slice2.txt", [README])
    frame = next(open_dataset(tmp_path).frames)
    assert frame.frame == "slice2-c0-2011-04-21/img_00122_c0_1303398475046031us_rect"
    assert frame.pose.x == -85.392177


def test_strange_names_are_left_out_and_counted(tree):
    plant(tree / "slice7" / "query", "overview.jpg", "img_00001_c0_12us.jpg")
    dataset = open_dataset(tree)
    assert len(list(dataset.frames)) == 12
    assert any(
        "2 images" in note and "left out, for example 'img_00001_c0_12us.jpg'" in note
        for note in dataset.warnings
    )


# ---- poses


def test_the_example_of_the_data_set(tmp_path):
    """By hand from the published line: the third row of the rotation is (-0.888, 0.456, 0.063) and
    the second, which is down, (-0.019, 0.099, -0.995): so z is up, and the camera looks west by
    north."""
    known = read_list(write(tmp_path / "poses.txt", [README]))
    x, y, heading = known["img_00122_c0_1303398475046031us"]
    assert (x, y) == (-85.392177, 55.210379)
    assert heading == pytest.approx(math.atan2(0.4562, -0.8877), abs=1e-3)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.jpg 1 0 0 0 1 2", "line 3: expected 7 numbers, got 6"),
        ("a.jpg 1 0 0 0 1 2 3 4", "line 3: expected 7 numbers, got 8"),
        ("a.jpg", "line 3: expected 7 numbers, got 0"),
        ("a.jpg 1 0 0 0 east 2 3", "line 3: .*'east'"),
        ("a.jpg 0 0 0 0 1 2 3", "line 3: .* is not a rotation"),
        ("\x00\x01\x02", "line 3: expected 7 numbers"),
    ],
)
def test_damaged_lists_are_refused_by_file_and_line(tmp_path, line, message):
    path = write(tmp_path / "poses.txt", ["# name qw qx qy qz cx cy cz", README, line])
    with refused(message, path):
        read_list(path)
