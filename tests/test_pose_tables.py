"""Which row of a table of poses is the pose of a frame."""

import math
from pathlib import Path

import numpy as np
import pytest
from helpers import refuses, street, touch
from trees import write

from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.pose_tables import PoseTable


def plant(root, table, *files):
    """Empty files, and a table of poses: x by frame."""
    touch(*(root / file for file in files))
    rows = (f"{frame},{x},0" for frame, x in table.items())
    return write(root / "poses.csv", ["frame,x,y", *rows])


def found(*folders, **options):
    return [file.pose.x for file in find_label_files([str(f) for f in folders], **options)]


def test_poses_lie_in_the_folder_or_beside_it(tmp_path):
    folder = tmp_path / "maps" / "monday"
    plant(tmp_path, {"1": 1}, "maps/monday/1.png")
    assert PoseTable.of_folder(folder) is None, "two folders up is too far"
    plant(folder.parent, {"1": 2})
    assert found(folder) == [2]
    plant(folder, {"1": 3})
    assert found(folder) == [3]


@pytest.mark.parametrize("folder", [".", "../monday", "tuesday/.."])
def test_poses_beside_a_relative_folder_are_found(tmp_path, monkeypatch, folder):
    (tmp_path / "monday" / "tuesday").mkdir(parents=True)
    plant(tmp_path, {"1": 2})
    monkeypatch.chdir(tmp_path / "monday")
    assert PoseTable.of_folder(Path(folder)).poses["1"].x == 2


BOTH = ("monday/0.png", "tuesday/0.png")
NAMED = [
    ({"monday/0": 1, "tuesday/0": 2}, {}, 2),
    ({"monday/0": 1, "tuesday/0": 2}, {"sequence": "monday"}, 2),
    ({"monday/0": 1}, {"sequence": "monday"}, math.nan),
    ({"tuesday/0": 2}, {"sequence": "monday"}, 2),
    ({"drive/0": 3}, {"sequence": "drive"}, 3),
    ({"0": 1, "tuesday/0": 2}, {}, 2),
    ({"0.png": 1, "monday/0": 2}, {"sequence": "tuesday"}, 1),
    ({"tuesday/0.png": 2}, {}, 2),
    ({"tuesday/0.jpg": 2}, {}, 2),
]


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize(("table", "options", "x"), NAMED)
def test_an_id_of_another_folder_is_not_taken(tmp_path, table, options, x, given):
    path = plant(tmp_path, table | {"other/9": 9}, *BOTH, "tuesday/9.png")
    poses = {"poses": str(path)} if given and not math.isnan(x) else {}
    assert found(tmp_path / "tuesday", **options, **poses)[0] == pytest.approx(x, nan_ok=True)


def test_rows_that_differ_for_one_frame_are_refused(tmp_path):
    path = plant(tmp_path, {"a/0": 1, "drive/0": 2}, "a/0.png")
    with pytest.raises(ValueError, match=r"has 'a/0' and 'drive/0' for .*0\.png; expected"):
        found(tmp_path / "a", sequence="drive", poses=str(path))


def test_a_bare_name_that_two_folders_have_is_refused(tmp_path):
    path = plant(tmp_path, {"0": 1}, *BOTH, "images/0.jpg")
    message = r"row '0' of .*poses.csv can be a frame of .*tuesday and of .*monday; expected"
    monday, tuesday = tmp_path / "monday", tmp_path / "tuesday"
    refuses(message, found, tuesday)
    refuses("can be a frame of", found, monday, tuesday, poses=str(path))
    assert found(tuesday, poses=str(path)) == [1]
    (monday / "0.png").unlink()
    assert found(tuesday) == [1]


def test_folders_beside_each_subfolder_are_searched(tmp_path):
    files = "monday/labels/0.png", "monday/images/1.jpg", "tuesday/images/1.jpg"
    plant(tmp_path, {"0": 1, "1": 2}, *files)
    monday = tmp_path / "monday"
    table = PoseTable.of_folder(monday)
    paths = monday / "labels" / "0.png", monday / "images" / "1.jpg"
    first, second = (FrameFile("monday", p.stem, p, folder=str(monday)) for p in paths)
    assert table.pose_of(first).x == 1
    refuses("can be a frame of .*monday and of .*tuesday", table.pose_of, second)


def test_each_frame_has_its_own_row(tmp_path):
    """By id, by name, of a folder beside the table, and of a stack."""
    path = plant(tmp_path / "a", {"a/0": 1, "1": 4, "b/2": 7}, "0.png", "1.png", "2.png")
    path.write_text(path.read_text().replace("x,y", "x,y,heading").replace(",0\n", ",2,3\n"))
    poses = [file.pose for file in find_label_files([str(path.parent)])]
    assert poses[:2] == [(1, 2, 3), (4, 2, 3)]
    assert np.isnan(poses[2]).all()
    plant(tmp_path, {"9": 1, "b/9": 2}, "b/9.png", "c/9.png")
    assert found(tmp_path / "c", tmp_path / "b") == [1, 2]
    np.save(tmp_path / "s.npy", np.stack([street(0)] * 2))
    plant(tmp_path, {"s/s-000001": 1, "s-000000": 3})
    assert found(tmp_path / "s.npy") == [3, 1]


def test_a_name_may_be_written_with_combining_marks(tmp_path):
    """As the disk of a Mac does."""
    plant(tmp_path / "a", {"stra\u00dfe \u00e4": 1}, "stra\u00dfe a\u0308.png")
    assert found(tmp_path / "a") == [1]


def test_a_table_that_fits_no_frame_is_noted(tmp_path):
    path = plant(tmp_path / "a", {"1": 1}, "000001.png")
    notes = []
    assert np.isnan(found(tmp_path / "a", note=notes.append)).all()
    assert notes == [
        f"{path} has none of the frames, for example a/000001; it has, for example, '1'"
    ]


def test_damaged_poses_are_refused_before_anything_is_read(tmp_path):
    touch(tmp_path / "a" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x\n")
    refuses(r"poses\.csv.*no column 'y'", find_label_files, [str(tmp_path / "a")])
