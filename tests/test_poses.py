"""Poses from ``poses.csv``."""

import math

import pytest
from helpers import refused

from ssrvlad_torch.datasets.poses import Pose, read_poses


def write(folder, text, encoding="utf-8"):
    path = folder / "poses.csv"
    path.write_text(text, encoding=encoding)
    return path


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
def test_tables(tmp_path, text, poses):
    found = read_poses(write(tmp_path, text))
    assert found.keys() == poses.keys()
    for frame, pose in poses.items():
        assert found[frame] == pytest.approx(Pose(*pose), nan_ok=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'frame'"),
        ("frame,x\n1,2\n", "no column 'y'"),
        ("1,2,3,0\n", "no column 'frame'"),
        ("frame,x,y\n1,2,3\n2,east,4\n", "line 3: .*'east'"),
        ("frame,x,y\n0,inf,1\n", "line 2: x is inf; expected a finite number"),
        ("frame,x,y\n0,1,1\n0,2,1\n", "line 3: frame '0' has two positions"),
        ("frame,x,y,heading\n0,1,5,2,5,0\n", "line 2: more cells than columns: 5,0"),
        ("frame,x,y,x\n0,1,1,2\n", "line 1: two columns 'x'"),
        ("frame,x,y\n1,2\n", "line 2: could not convert string to float: ''"),
        ("frame,x,y,heading\n1,2,3,north\n", "line 2: .*'north'"),
        ("frame,x,y\n0,1_000,1\n", "line 2: .*'1_000'"),
        ("frame,x,y\n0,1,nan\n", "line 2: x is 1 and y is nan; expected two numbers, or nan twice"),
        ("frame,x,y\n" + "1" * 200_000 + ",2,3\n", "field larger"),
    ],
)
def test_damaged_files_are_refused_by_name_and_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with refused(message, path):
        read_poses(path)


def test_another_encoding_is_refused_by_name(tmp_path):
    path = write(tmp_path, "frame,x,y\nstraße,2,3\n", "latin-1")
    with pytest.raises(ValueError, match=r"poses\.csv.*utf-8"):
        read_poses(path)
