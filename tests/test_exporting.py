"""Exported databases, read back with NumPy and h5py."""

import json

import numpy as np
import pytest
from helpers import descriptors, record, touch

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.channels import Column
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.exporting import export_database

CONFIG = SSRVLADConfig.from_preset("paper", labels_as="camvid-11")
FRAMES = ("a/2", "a/1", "b/straße 🚗", "a/10")


@pytest.fixture
def database(tmp_path):
    made = Database.create(tmp_path / "db", CONFIG)
    numbers = descriptors(0, len(FRAMES))
    numbers[1] = 0
    made.append([record(frame) for frame in FRAMES], numbers)
    return made


def test_npy_is_an_array_with_names_settings_and_fingerprint(database, tmp_path):
    file = tmp_path / "out.npy"
    ends = (".frames.txt", ".json", ".fingerprint.txt")
    frames, settings, fingerprint = beside = [file.with_name(f"out.npy{end}") for end in ends]
    assert export_database(database, "npy", file) == [file, *beside]
    assert fingerprint.read_text().strip() == CONFIG.fingerprint
    assert json.loads(settings.read_text())["config"] == CONFIG.to_dict()
    np.testing.assert_array_equal(np.load(file), database.load().descriptors.numpy())
    names = frames.read_text(encoding="utf-8").splitlines()
    assert names == ["a/1", "a/2", "a/10", "b/straße 🚗"]
    database.append([record("c/1", x=0.1, y=-2.0)], descriptors(0, 1))
    poses = file.with_name("out.npy.poses.npy")
    assert poses in export_database(database, "npy", file)
    expected = [*[[np.nan] * 3] * 4, [0.1, -2, np.nan]]
    np.testing.assert_array_equal(np.load(poses), expected)


def test_an_export_deletes_the_files_of_an_earlier_one(database, tmp_path):
    """Features of another map, or a fingerprint, would be taken for those of the array."""
    columns = [Column("features", "of a network", (2, 4), "uint8")]
    seen = Database.create(tmp_path / "seen", CONFIG, columns=columns)
    signs = np.zeros((4, 2, 4), np.uint8)
    seen.append(FRAMES, {"ssr-vlad": descriptors(0, 4), "features": signs})
    file, other = tmp_path / "out.npy", tmp_path / "out.npy2.npy"
    whole = [{*export_database(seen, "npy", target)} for target in (other, file)]
    assert [len(files) for files in whole] == [6, 6]
    mine = {tmp_path / f"out.npy.mine{end}" for end in ("", ".fingerprint.txt")}
    touch(*mine)
    stays = whole[0] | mine
    left = {*export_database(database, "npy", file)}
    assert {*tmp_path.glob("out*")} == stays | left
    bare = Database.create(tmp_path / "bare", width=480)
    left = {*export_database(bare, "npy", file)}
    assert {*tmp_path.glob("out*")} == stays | left and len(left) == 3


@pytest.mark.parametrize("form", ["npy", "hloc"])
def test_an_empty_database_is_exported(tmp_path, form, monkeypatch):
    """Also on a system without posix_fallocate."""
    pytest.importorskip("h5py", reason="needs the extra hloc")
    monkeypatch.delattr("os.posix_fallocate")
    export_database(Database.create(tmp_path / "db", CONFIG), form, tmp_path / "out")
    assert (tmp_path / "out").stat().st_size


def test_an_id_of_several_lines_is_refused_for_npy(database, tmp_path):
    database.append([record("a/1\u2028b")], descriptors(1, 1))
    with pytest.raises(ValueError, match=r"one id per line, and 1 of .* first is 'a/1\\u2028b'"):
        export_database(database, "npy", tmp_path / "out.npy")
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["db"]
