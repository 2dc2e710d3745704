"""Files that are written whole or not at all."""

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.datasets.names import absolute_folder
from ssrvlad_torch.files import natural_key, replacing


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    return path


def test_the_new_file_takes_the_place_of_the_old_one(old):
    with replacing(old) as temporary:
        temporary.write_text("new")
        assert old.read_text() == "old"
        assert temporary.parent == old.parent, "a rename works only inside one file system"
    assert old.read_text() == "new"
    assert names(old.parent) == ["file"]


def test_an_exception_leaves_the_old_file_and_nothing_else(old):
    with pytest.raises(KeyboardInterrupt), replacing(old) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert old.read_text() == "old"
    assert names(old.parent) == ["file"]


def test_a_full_disk_leaves_the_old_file_and_nothing_else(old, monkeypatch):
    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left.*file'$"), replacing(old) as temporary:
        temporary.write_text("new")
    assert old.read_text() == "old"
    assert names(old.parent) == ["file"]


def test_the_content_is_flushed_before_the_rename_and_the_folder_after_it(old, monkeypatch):
    flushed = []

    def watch(descriptor):
        flushed.append((os.fstat(descriptor).st_ino, old.read_text()))

    monkeypatch.setattr(os, "fsync", watch)
    with replacing(old) as temporary:
        temporary.write_text("new")
    assert flushed == [(old.stat().st_ino, "old"), (old.parent.stat().st_ino, "new")]


@pytest.mark.parametrize("folder", ["missing", "file"])
def test_a_place_that_cannot_hold_a_file_is_an_error(old, folder):
    target = old.parent / folder / "x"
    with pytest.raises(OSError, match=folder), replacing(target) as temporary:
        temporary.write_text("new")
    assert names(old.parent) == ["file"]


def test_dots_have_a_name_and_a_parent(tmp_path, monkeypatch):
    (tmp_path / "maps" / "monday").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "maps" / "monday")
    maps = tmp_path / "maps"
    assert absolute_folder(Path()) == maps / "monday"
    assert absolute_folder(Path("..")) == maps
    assert absolute_folder(Path("../../maps/monday")).name == "monday"
    assert absolute_folder(Path("../monday/..")).name == "maps"


def test_a_link_keeps_its_own_name(tmp_path):
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    assert absolute_folder(tmp_path / "link").name == "link"


@given(st.permutations(["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]))
def test_natural_keys(names):
    expected = ["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]
    assert sorted(names, key=natural_key) == expected


@given(st.permutations(["7.5", "102.0", "102.125", "102.25", "102.5", "102.75", "103.000001", "a"]))
def test_decimal_times_are_ordered_by_value(names):
    expected = ["7.5", "102.0", "102.125", "102.25", "102.5", "102.75", "103.000001", "a"]
    assert sorted(names, key=natural_key) == expected
