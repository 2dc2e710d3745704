"""Which row of a table of poses is the pose of a frame."""

import math
from pathlib import Path

import numpy as np
import pytest
from helpers import street, touch

from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.datasets.pose_tables import PoseTable


def plant(root, table, *files):
    """Empty files, and a table of poses: x by frame."""
    for path in (root / file for file in files):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    rows = "".join(f"{frame},{x},0\n" for frame, x in table.items())
    (root / "poses.csv").write_text(f"frame,x,y\n{rows}")
    return root / "poses.csv"


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
def test_poses_beside_a_relative_folder(tmp_path, monkeypatch, folder):
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
    with pytest.raises(ValueError, match=message):
        found(tuesday)
    with pytest.raises(ValueError, match="can be a frame of"):
        found(monday, tuesday, poses=str(path))
    assert found(tuesday, poses=str(path)) == [1]
    (monday / "0.png").unlink()
    assert found(tuesday) == [1]


def test_poses_are_found_by_id_and_by_name(tmp_path):
    folder = tmp_path / "a"
    touch(*(folder / f"{number}.png" for number in range(4)))
    (folder / "poses.csv").write_text("frame,x,y,heading\na/0,1,2,3\n1,4,5,6\nb/2,7,8,9\n")
    poses = [file.pose for file in find_label_files([str(folder)])]
    assert poses[:2] == [(1, 2, 3), (4, 5, 6)]
    assert np.isnan(poses[2:]).all()


def test_names_in_poses_may_have_the_suffix_of_the_file(tmp_path):
    touch(tmp_path / "a" / "0.png", tmp_path / "a" / "1.png")
    (tmp_path / "a" / "poses.csv").write_text("frame,x,y\n0.png,1,2\na/1.png,3,4\n")
    for files in (
        find_label_files([str(tmp_path / "a")]),
        find_label_files([str(tmp_path / "a")], poses=str(tmp_path / "a" / "poses.csv")),
    ):
        assert [file.pose[:2] for file in files] == [(1, 2), (3, 4)]


def test_an_id_in_poses_goes_before_a_bare_name(tmp_path):
    touch(tmp_path / "a" / "0.png", tmp_path / "b" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x,y\n0,1,1\nb/0,2,2\n")
    files = find_label_files([str(tmp_path / "a"), str(tmp_path / "b")])
    assert [file.pose.x for file in files] == [1, 2]


def test_a_sequence_that_is_named_anew_keeps_its_poses(tmp_path):
    touch(tmp_path / "a" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x,y\na/0,1,2\n")
    (file,) = find_label_files([str(tmp_path / "a")], sequence="drive")
    assert file.pose[:2] == (1, 2)


def test_poses_of_a_stack(tmp_path):
    np.save(tmp_path / "s.npy", np.stack([street(0)] * 2))
    (tmp_path / "poses.csv").write_text("frame,x,y\ns/s-000001,1,2\ns-000000,3,4\n")
    files = find_label_files([str(tmp_path / "s.npy")])
    assert [file.pose.x for file in files] == [3, 1]


def test_damaged_poses_are_refused_before_anything_is_read(tmp_path):
    touch(tmp_path / "a" / "0.png")
    (tmp_path / "poses.csv").write_text("frame,x\n")
    with pytest.raises(ValueError, match=r"poses\.csv.*no column 'y'"):
        find_label_files([str(tmp_path / "a")])
