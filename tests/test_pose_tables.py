"""Tables of poses, and which row is the pose of a frame."""

import math

import numpy as np
import pytest
from helpers import refused, refuses, touch
from layout_copies import write

from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.pose_tables import PoseTable, read_poses
from ssrvlad_torch.datasets.poses import Pose

NAN = math.nan


@pytest.mark.parametrize(
    ("text", "poses"),
    [
        (  # columns have names
            "heading,time,y,frame,x\n0.5,7,-2,monday/001,1.25\n1,8,3e2,002,0\n",
            {"monday/001": (1.25, -2, 0.5), "002": (0, 300, 1)},
        ),
        ("frame,x,y\n1.5.png,2,3\n", {"1.5": (2, 3, NAN)}),
        ("frame,x,y,heading\n1,2,3,\n", {"1": (2, 3, NAN)}),
        # what spreadsheets write: a byte order mark, a space after the comma, CRLF, empty cells
        ('\ufeffframe, x, y,,\r\n"a,b", 2, 3,,, ,\r\n', {"a,b": (2, 3, NAN)}),
        ("frame,x,y,heading\n", {}),
    ],
)
def test_tables_are_read_by_column_name(tmp_path, text, poses):
    table = read_poses(write(tmp_path / "poses.csv", text))
    assert table.keys() == poses.keys()
    for frame, pose in poses.items():
        assert table[frame] == pytest.approx(Pose(*pose), nan_ok=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'frame'"),
        ("frame,x\n1,2\n", "no column 'y'"),
        ("frame,x,y\n1,2,3\n2,east,4\n", "line 3: .*'east'"),
        ("frame,x,y\n0,inf,1\n", "line 2: expected a finite number, got inf"),
        ("frame,x,y\n0,1,1\n0.png,2,1\n", "line 3: frame '0.png' has two poses"),
        ("frame,x,y,heading\n0,1,5,2,5,0\n", "line 2: more cells than columns: 5,0"),
        ("frame,x,y,x\n0,1,1,2\n", "line 1: two columns 'x'"),
        ("frame,x,y\n0,1,nan\n", "line 2: x is 1 and y is nan; expected two numbers, or nan twice"),
        ("frame,x,y\n" + "1" * 200_000 + ",2,3\n", "field larger"),
        ("frame,x,y\nstraße,2,3\n", "utf-8"),
    ],
)
def test_damaged_tables_are_refused_by_name_and_line(tmp_path, text, message):
    """The last is in another encoding; for the others the two are one."""
    path = tmp_path / "poses.csv"
    path.write_text(text, encoding="latin-1")
    with refused(message, path):
        read_poses(path)


def plant(root, table, *files):
    """Empty files, and a table of poses: x by frame."""
    touch(*(root / file for file in files))
    rows = (f"{frame},{x},0" for frame, x in table.items())
    return write(root / "poses.csv", ["frame,x,y", *rows])


def x_of(*folders, **options):
    return [file.pose.x for file in find_label_files([str(f) for f in folders], **options)]


def test_poses_lie_in_the_folder_or_beside_it(tmp_path):
    folder = tmp_path / "maps" / "monday"
    plant(tmp_path, {"1": 1}, "maps/monday/1.png")
    assert PoseTable.of_folder(folder) is None, "two folders up is too far"
    plant(folder.parent, {"1": 2})
    assert x_of(folder) == [2]
    plant(folder, {"1": 3})
    assert x_of(folder) == [3]


BOTH = ("monday/0.png", "tuesday/0.png")
NAMED = [
    ({"monday/0": 1, "tuesday/0": 2}, {}, 2),
    ({"monday/0": 1, "tuesday/0": 2}, {"sequence": "monday"}, 2),
    ({"monday/0": 1}, {"sequence": "monday"}, NAN),
    ({"tuesday/0": 2}, {"sequence": "monday"}, 2),
    ({"drive/0": 3}, {"sequence": "drive"}, 3),
    ({"0": 1, "tuesday/0": 2}, {}, 2),
    ({"0.png": 1, "monday/0": 2}, {"sequence": "tuesday"}, 1),
    ({"tuesday/0.jpg": 2}, {}, 2),
]


@pytest.mark.parametrize("by_name", [False, True])
@pytest.mark.parametrize(("table", "options", "x"), NAMED)
def test_an_id_of_another_folder_is_not_taken(tmp_path, table, options, x, by_name):
    path = plant(tmp_path, table | {"other/9": 9}, *BOTH, "tuesday/9.png")
    poses = {"poses": str(path)} if by_name and not math.isnan(x) else {}
    assert x_of(tmp_path / "tuesday", **options, **poses)[0] == pytest.approx(x, nan_ok=True)


def test_rows_that_differ_for_one_frame_are_refused(tmp_path):
    path = plant(tmp_path, {"a/0": 1, "drive/0": 2}, "a/0.png")
    with pytest.raises(ValueError, match=r"has 'a/0' and 'drive/0' for .*0\.png; expected"):
        x_of(tmp_path / "a", sequence="drive", poses=str(path))


def test_a_bare_name_that_two_folders_have_is_refused(tmp_path):
    path = plant(tmp_path, {"0": 1}, *BOTH, "images/0.jpg")
    message = r"row '0' of .*poses.csv can be a frame of .*tuesday and of .*monday; expected"
    monday, tuesday = tmp_path / "monday", tmp_path / "tuesday"
    refuses(message, x_of, tuesday)
    refuses("can be a frame of", x_of, monday, tuesday, poses=str(path))
    assert x_of(tuesday, poses=str(path)) == [1]
    (monday / "0.png").unlink()
    assert x_of(tuesday) == [1]


def test_a_frame_has_the_row_of_its_id_or_of_its_name(tmp_path):
    path = plant(tmp_path / "a", {"a/0": 1, "1": 4, "b/2": 7}, "0.png", "1.png", "2.png")
    path.write_text(path.read_text().replace("x,y", "x,y,heading").replace(",0\n", ",2,3\n"))
    poses = [file.pose for file in find_label_files([str(path.parent)])]
    assert poses[:2] == [(1, 2, 3), (4, 2, 3)]
    assert np.isnan(poses[2]).all()


@pytest.mark.parametrize(
    ("row", "share"), [("1", "none of the"), ("000000", "1 of 3"), ("none/000001", "none of the")]
)
def test_a_table_that_fits_few_frames_is_noted(tmp_path, row, share):
    path = plant(tmp_path / "a", {row: 1}, "000000.png", "000001.png", "000002.png")
    notes = []
    x_of(tmp_path / "a", note=notes.append)
    missing = "a/000001" if share[0] == "1" else "a/000000"
    assert notes[-1] == (
        f"{path} has {share} frames, not {missing} for example; it has, for example, '{row}'"
    )


def test_a_table_that_was_named_and_fits_no_frame_is_refused(tmp_path):
    other = str(plant(tmp_path / "other", {"9": 1}, "../monday/1.png"))
    message = r"poses\.csv has none of the frames, not monday/1"
    refuses(message, x_of, tmp_path / "monday", poses=other)
    refuses("expected a file of poses, or exif", x_of, tmp_path / "monday", poses="gps")
