"""Versions of a database, several writers of one, and whole and truncated files."""

import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers import CONFIG, FRAMES, descriptors, fill, filled, loaded, refused, refuses

from ssrvlad_torch import Database
from ssrvlad_torch.database import engine

ONE = descriptors(1, 1)


@pytest.fixture
def path(tmp_path):
    return filled(tmp_path)


def test_merges_and_removals_are_one_commit_each_and_are_in_the_history(path):
    database = Database.open(path)
    database.merge(["day/2", "night/1"], torch.zeros(2, 480))
    assert database.load().empty.tolist() == [True, False, False, True]
    database.merge(["day/2", "new/1"], descriptors(5, 2))
    assert database.load().frames == ("day/2", "day/9", "day/10", "new/1", "night/1")
    assert not database.load().empty[0]
    database.remove({"day/9", "day/10", "never/1"})
    refuses("expected a list of frames, got the text 'day/2'", database.remove, "day/2")
    assert database.load().frames == ("day/2", "new/1", "night/1")
    changes = [(entry.frames, entry.change.split()[0]) for entry in database.history()]
    assert changes == [(0, "create"), (4, "append"), (4, "merge"), (5, "merge"), (3, "remove")]
    first = database.history()[1].version
    assert torch.equal(
        Database.open(path, first).load().descriptors, descriptors(0, 4)[[1, 3, 0, 2]]
    )
    refuses("as of version", Database.open(path, first).remove, ["day/2"])
    database.remove(["day/2", "new/1", "night/1"])
    assert len(database.load()) == 0
    fill(database, ["a/1"])
    assert list(loaded(path)) == ["a/1"]


def test_a_writer_and_a_reader_survive_that_their_version_is_deleted(path, monkeypatch):
    """The writer plans again; the reader is told to open the database again."""
    reader, writer, plan = Database.open(path), Database.open(path), engine.replacement

    def meanwhile(*arguments):
        monkeypatch.setattr(engine, "replacement", plan)
        other = Database.open(path)
        other.append(["b/1"], descriptors(1, 1))
        other.compact(keep_days=0)
        return plan(*arguments)

    monkeypatch.setattr(engine, "replacement", meanwhile)
    writer.merge(["a/1", "b/1"], descriptors(2, 2))
    rows = loaded(path)
    assert rows.keys() == {*FRAMES, "a/1", "b/1"}
    assert rows["b/1"] == descriptors(2, 2)[1].tolist()
    refuses(r"^version 2 of .*town\.ssrdb was deleted since: open it again$", reader.load)


def test_compacting_joins_files_and_deletes_old_versions(path):
    database = Database.open(path)
    for number in range(6):
        fill(database, [f"more/{number}"], number)
    database.remove(["day/2"])
    before, files = loaded(path), len(list(path.glob("data/*.lance")))
    database.compact(keep_days=0)
    assert loaded(path) == before
    assert len(list(path.glob("data/*.lance"))) < files
    assert len(database.history()) == 1
    fill(database, ["day/2"])
    assert len(Database.open(path)) == len(before) + 1


def test_a_change_is_checked_against_what_others_have_written(path):
    """Not against the version that the writer has read."""
    database, seen = Database.open(path), []

    def check(known):
        seen.append(sorted(known))
        if "other/0" in known:
            raise ValueError("other/0 is there")

    database.merge(["a/0"], descriptors(0, 1), check=check)
    assert not seen
    Database.open(path).append(["other/0"], descriptors(1, 1))
    refuses("other/0 is there", database.merge, ["a/1"], ONE, check=check)
    assert seen == [sorted([*FRAMES, "a/0", "other/0"])]
    assert len(Database.open(path)) == len(FRAMES) + 2


def test_what_others_write_before_an_origin_is_added_is_checked(path):
    database = Database.open(path)

    def check(known):
        if "other/0" in known:
            raise ValueError("other/0 is there")

    Database.open(path).append(["other/0"], ONE)
    database.add_origin(None, "another network")
    refuses("other/0 is there", database.merge, ["a/1"], ONE, check=check)


def in_threads(*works):
    """Runs functions in threads at once, and returns their errors."""
    ready = threading.Barrier(len(works))
    with ThreadPoolExecutor(len(works)) as pool:
        done = [pool.submit(lambda work=work: (ready.wait(), work())) for work in works]
    return [task.exception() for task in done if task.exception()]


def test_writers_that_start_at_once_make_one_database(tmp_path):
    path = tmp_path / "db"

    def add(number):
        fill(Database.open_or_create(path, CONFIG), [f"{number}/0"])

    assert in_threads(*(partial(add, number) for number in range(4))) == []
    assert set(loaded(path)) == {f"{n}/0" for n in range(4)}


@pytest.mark.parametrize("version", [0, -1, 99, 10**20])
def test_a_version_that_is_not_there_is_refused(path, version):
    refuses(rf"town\.ssrdb has no version {version}; it has 1 to 2$", Database.open, path, version)
    Database.open(path).compact(keep_days=0)
    only = Database.open(path).version
    refuses(f"has no version {version}; it has {only}$", Database.open, path, version)


def test_a_table_with_rows_is_never_renamed(path, monkeypatch):
    monkeypatch.setattr(Path, "rename", None)
    engine.discard_empty(str(path))
    assert loaded(path).keys() == {*FRAMES}


def test_a_table_that_cannot_be_read_is_not_discarded(path):
    """As without open files, at the end of a run that failed for the same reason."""
    for version in path.glob("_versions/*"):
        version.write_bytes(b"torn")
    engine.discard_empty(str(path))
    assert Database.exists(path)


def test_a_table_keeps_its_name_if_discarding_is_interrupted(tmp_path, monkeypatch):
    Database.create(tmp_path / "db", CONFIG)

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", interrupt)
    with pytest.raises(KeyboardInterrupt):
        engine.discard_empty(str(tmp_path / "db"))
    assert [*tmp_path.iterdir()] == [tmp_path / "db"] and len(Database.open(tmp_path / "db")) == 0


FORKED = """
import os, sys, torch
from ssrvlad_torch import Database
path, before = sys.argv[1], sys.argv[2] == "before"
if before:
    database = Database.open(path)
    frames = database.load()
if not os.fork():
    if not before:
        sys.exit(len(Database.open(path).load()) != 4)
    uses = [Database.open, lambda _: database.known(), lambda _: database.remove(["day/2"])]
    for use in uses:
        try:
            use(path)
        except RuntimeError as error:
            print(error)
    sys.exit()
code = os.waitstatus_to_exitcode(os.wait()[1])
if before:
    database.remove(["day/2"])
sys.exit(code)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize("used", ["before", "after"])
def test_a_process_forked_after_a_database_was_used_is_refused(path, used):
    """There Lance hangs or crashes; the workers of a DataLoader are forked. A process forked before
    is not refused, and the parent goes on."""
    command = [sys.executable, "-c", FORKED, path, used]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    refusals = done.stdout.splitlines()
    assert len(refusals) == (3 if used == "before" else 0)
    assert all('spawned, as by DataLoader(multiprocessing_context="spawn")' in r for r in refusals)


def test_an_interrupt_or_a_panic_of_lance_is_no_damage():
    with pytest.raises(KeyboardInterrupt), engine.lance_errors(ValueError, "town is damaged"):
        raise OSError("External error: KeyboardInterrupt: ")
    with refused("^Lance failed: Task was aborted$", by=OSError):  # noqa: SIM117
        with engine.lance_errors(ValueError, "town is damaged"):
            raise RuntimeError("Task was aborted")


@pytest.mark.parametrize("empty", [True, False])
def test_of_several_writers_of_one_frame_one_succeeds(tmp_path, empty):
    path = tmp_path / "db"
    Database.create(path, CONFIG)
    if not empty:
        fill(Database.open(path), FRAMES)
    handles = [Database.open(path) for _ in range(4)]
    works = (partial(h.append, ["same/1"], descriptors(n, 1)) for n, h in enumerate(handles))
    errors = in_threads(*works)
    assert [*map(str, errors)] == [f"frame 'same/1' is in {path} already"] * 3
    assert len(loaded(path)) == (1 if empty else 5)


def test_concurrent_changes_of_all_kinds_are_applied_one_after_another(path):
    """Each writer changes only its own frames, so every order gives the same result."""

    def change(name):
        database = Database.open(path)
        fill(database, [f"{name}/{n}" for n in range(4)])
        database.remove([f"{name}/0"])
        database.merge([f"{name}/1"], torch.zeros(1, 480))
        database.merge([f"{name}/2", f"{name}/5"], descriptors(9, 2))
        database.add_origin(None, name)

    def compact():
        for _ in range(3):
            Database.open(path).compact()

    assert in_threads(*(partial(change, name) for name in "abc"), compact) == []
    rows = loaded(path)
    assert set(rows) == {*FRAMES, *(f"{name}/{n}" for name in "abc" for n in (1, 2, 3, 5))}
    for name in "abc":
        assert not any(rows[f"{name}/1"])
        assert rows[f"{name}/2"] == descriptors(9, 2)[0].tolist()
        assert rows[f"{name}/3"] == descriptors(0, 4)[3].tolist()
    assert {origin.segmenter for origin in Database.open(path).origins.values()} == {"a", "b", "c"}
