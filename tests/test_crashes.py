"""Nothing lost, nothing half done: writers that are killed, full disks, read-only places."""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from helpers import descriptors, record, write_street

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.database.database import Database, mapped_array
from ssrvlad_torch.database.exporting import export_database
from ssrvlad_torch.database.searching import load_mapped
from ssrvlad_torch.database.storage.verification import verify
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_database

HERE = Path(__file__).parent
CONFIG = SSRVLADConfig.from_preset("paper", labels_as="camvid-11")


@pytest.fixture(scope="session")
def shim(tmp_path_factory):
    """The library that kills a writer."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("g++")
    if compiler is None:
        pytest.skip("needs a C compiler")
    target = tmp_path_factory.mktemp("shim") / "crashing.so"
    source = HERE / "crashing.c"
    subprocess.run([compiler, "-shared", "-fPIC", "-xc", source, "-o", target, "-ldl"], check=True)
    return target


def crashes(shim, folder, *arguments):
    done = subprocess.run(
        [sys.executable, HERE / "crashes.py", shim, folder, *arguments],
        env={**os.environ, "LD_PRELOAD": str(shim), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [int(line) for line in done.stdout.split()]


def test_a_writer_that_is_killed_loses_nothing(shim, tmp_path):
    """At some of the calls that the next test tries all."""
    fresh, updated = crashes(shim, tmp_path, "every", "9")
    assert fresh >= 2
    assert updated >= 4


@pytest.mark.slow
def test_a_writer_that_is_killed_at_any_call_loses_nothing(shim, tmp_path):
    """At every write, half a write, flush, link, rename and removal, of a new database and of one
    in which frames are added, replaced and removed."""
    fresh, updated = crashes(shim, tmp_path, "every", "1")
    assert fresh >= 30
    assert updated >= 40


@pytest.mark.slow
def test_a_writer_that_is_killed_at_any_moment_loses_nothing(shim, tmp_path):
    assert crashes(shim, tmp_path, "random", "100") == [100]


@contextmanager
def no_file_longer_than(size):
    """What a full disk does to a writer."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 100, 1000, 4000, 6000])
def test_a_full_disk_is_an_error_and_the_database_is_as_it_was(tmp_path, size):
    database = Database.create(tmp_path / "db", CONFIG)
    database.append([record(f"a/{n}") for n in range(3)], descriptors(0, 3))
    before = {entry.name: entry.read_bytes() for entry in database.path.glob("[mp]*")}
    opened = Database.open(tmp_path / "db")
    with no_file_longer_than(size), pytest.raises(OSError, match="File too large") as refusal:
        opened.append([record(f"b/{n}") for n in range(3)], descriptors(1, 3))
    assert "\n" not in str(refusal.value)
    assert {entry.name: entry.read_bytes() for entry in database.path.glob("[mp]*")} == before
    assert verify(database.path) == []
    opened.append([record(f"b/{n}") for n in range(3)], descriptors(1, 3))
    assert len(Database.open(database.path)) == 6


def test_a_disk_that_fills_during_a_run_leaves_what_landed(tmp_path, monkeypatch):
    for number in range(40):
        write_street(tmp_path / "a" / f"{number}.png", number)
    head, files = SSRVLAD(CONFIG), find_label_files([str(tmp_path / "a")])
    database = Database.create(tmp_path / "db", CONFIG)
    encode_to_database(head, files[:3], database)
    with no_file_longer_than(5000), pytest.raises(OSError, match="File too large"):
        encode_to_database(head, files, database, 2)
    assert len(Database.open(database.path)) == 3
    assert encode_to_database(head, files, Database.open(database.path), 2).encoded == 37


@pytest.mark.parametrize("form", ["npy", "faiss", "hloc"])
def test_a_full_disk_is_one_line_for_every_form_of_export(tmp_path, form):
    pytest.importorskip("faiss", reason="needs the extra search")
    pytest.importorskip("h5py", reason="needs the extra search")
    database = Database.create(tmp_path / "db", CONFIG)
    database.append([record(f"a/{n}") for n in range(99)], descriptors(0, 99))
    with no_file_longer_than(4000), pytest.raises(OSError, match="out cannot be written") as full:
        export_database(database, form, tmp_path / "out")
    assert "\n" not in str(full.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["db"]


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_a_full_disk_leaves_no_matrix(tmp_path, precision):
    database = Database.create(tmp_path / "db", CONFIG)
    database.append([record(f"a/{n}") for n in range(99)], descriptors(0, 99))
    with no_file_longer_than(4000), pytest.raises(OSError, match="File too large"):
        load_mapped(database, 0, precision)
    assert not list(database.path.glob("*search-*"))


def test_a_mapped_array_has_its_room_before_anything_is_written(tmp_path):
    """Else a disk that is full ends the process with a signal."""
    mapped_array(tmp_path / "a.npy", (1000, 480))
    status = (tmp_path / "a.npy").stat()
    assert status.st_blocks * 512 >= status.st_size > 1000 * 480 * 4


def test_a_place_that_must_not_be_written_is_an_error_and_stays_as_it_was():
    """Tried by a user who may not; the administrator may everywhere."""
    folder = Path(tempfile.mkdtemp())
    try:
        database = Database.create(folder / "db", CONFIG)
        database.append([record("a/0")], descriptors(0, 1))
        before = {entry.name: entry.read_bytes() for entry in database.path.iterdir()}
        for place in (database.path, folder):
            place.chmod(0o555)
        for entry in database.path.iterdir():
            entry.chmod(0o444)
        assert "Permission denied" in as_nobody(lambda: append_one(database.path))
        assert "Permission denied" in as_nobody(lambda: Database.create(folder / "new", CONFIG))
        assert as_nobody(lambda: Database.open(database.path).load()) == ""
        assert {entry.name: entry.read_bytes() for entry in database.path.iterdir()} == before
    finally:
        for place in (folder, folder / "db"):
            place.chmod(0o755)
        shutil.rmtree(folder)


def append_one(path):
    Database.open(path).append([record("a/1")], descriptors(1, 1))


def as_nobody(action):
    """The OSError that an unprivileged process gets from an action, or nothing."""
    reading, telling = os.pipe()
    child = os.fork()
    if not child:
        message = "no answer"
        try:
            torch.set_num_threads(1)
            if os.getuid() == 0:
                os.setuid(65534)
            action()
            message = ""
        except OSError as error:
            message = str(error)
        finally:
            os.write(telling, message.encode())
            os._exit(0)
    os.close(telling)
    os.waitpid(child, 0)
    with os.fdopen(reading) as told:
        return told.read()
