"""Files that are written whole or not at all."""

import errno
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.files import natural_key, replacing


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    return path


def test_the_new_file_takes_the_place_of_the_old_one(old, monkeypatch):
    """Its content is flushed before the rename, and the folder after it."""
    flushed = []

    def watch(descriptor):
        flushed.append((os.fstat(descriptor).st_ino, old.read_text()))

    monkeypatch.setattr(os, "fsync", watch)
    with replacing(old) as temporary:
        temporary.write_text("new")
        assert old.read_text() == "old"
        assert temporary.parent == old.parent, "a rename works only inside one file system"
    assert flushed == [(old.stat().st_ino, "old"), (old.parent.stat().st_ino, "new")]
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


NAMES = ["9", "10", "f", "f9", "f9a", "f9a2", "f9a10", "f09b", "f10", "g01", "g1"]
TIMES = ["7.5", "102.0", "102.125", "102.25", "102.5", "102.75", "103.000001", "a"]


@given(st.permutations(NAMES), st.permutations(TIMES))
def test_names_sort_naturally_and_times_by_value(names, times):
    assert sorted(names, key=natural_key) == NAMES
    assert sorted(times, key=natural_key) == TIMES
