"""Durability: killed writers, full disks, no file handles, and the order of flushes."""

import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from helpers import descriptors

from ssrvlad_torch import Database
from ssrvlad_torch.database.exporting import export_database

HERE = Path(__file__).parent


def crashes(shim, folder, *arguments):
    """The lines that each part of `crashes.py` prints."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", HERE / "crashes.py", shim, folder, *arguments],
        env={**os.environ, "LD_PRELOAD": str(shim), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [part.splitlines() for part in done.stdout.split("--\n")]


def test_a_writer_that_is_killed_or_whose_calls_fail_loses_nothing(shim, tmp_path):
    """At some calls; the slow tests try all. Files are flushed before the commit that refers to
    them, and the manifest after it."""
    killed, failed, recorded = crashes(
        shim, tmp_path, *("every", "29"), *("fail", "29"), *("record", "0")
    )
    assert min(int(killed[0]), int(failed[0])) >= 3
    calls = [line.split(" ") for line in recorded]
    [commit] = [n for n, (call, name) in enumerate(calls) if call == "link"]
    manifest = calls[commit][1]
    assert manifest.startswith("/_versions/")
    before, after = (
        {name for call, name in part if call == "fsync"}
        for part in (calls[:commit], calls[commit:])
    )
    [data] = [name for name in before if name.endswith(".lance")]
    assert data.startswith("/data/") and "/data" in before
    assert any(call == "write" and "/data/" in name for call, name in calls[:commit])
    assert {manifest, "/_versions"} <= after


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["every", "fail"])
def test_a_writer_loses_nothing_at_any_call(shim, tmp_path, kind):
    """At every write, partial write, flush, link and removal. A call fails as on a full or broken
    disk or without file handles, also where Lance does not report it."""
    assert int(crashes(shim, tmp_path, kind, "1")[0][0]) >= 100


def test_a_file_system_without_hard_links_is_named_and_nothing_stays(shim, tmp_path):
    program = "import sys, ssrvlad_torch as s; s.Database.create(sys.argv[1], width=6)"
    done = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "town"],
        env={**os.environ, "LD_PRELOAD": str(shim), "WITHOUT_LINKS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "town cannot be written: the file system has no hard links" in done.stderr
    assert not [*tmp_path.iterdir()]


@contextmanager
def limited(what, most):
    """Sets a resource limit: a full disk, or too many open files."""
    soft, hard = resource.getrlimit(what)
    resource.setrlimit(what, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(what, (soft, hard))


SIZES = [(resource.RLIMIT_FSIZE, size) for size in (0, 100, 1000, 10_000)]


@pytest.mark.parametrize(
    ("change", "what", "most"),
    [(change, *limit) for change in ("append", "merge") for limit in SIZES]
    + [("append", resource.RLIMIT_NOFILE, 0)],
)
def test_without_disk_or_file_handles_the_database_is_unchanged(tmp_path, change, what, most):
    path = tmp_path / "db"
    Database.create(path, width=480).append(["a/1", "a/2"], descriptors(0, 2))
    frames = ["b/1", "b/2"] if change == "append" else ["a/1", "a/2"]
    database = Database.open(path)
    numbers = descriptors(1, 2)
    with limited(what, most):
        try:
            getattr(database, change)(frames, numbers)
        except OSError as error:
            assert "\n" not in str(error)
            assert str(path) in str(error)
        else:
            assert most == 10_000, "it fits"
            return
    assert torch.equal(Database.open(path).load().descriptors, descriptors(0, 2))
    getattr(database, change)(frames, numbers)
    assert Database.open(path).damage() == []
    assert len(Database.open(path)) == (4 if change == "append" else 2)


@pytest.mark.parametrize("form", ["npy", "hloc"])
def test_a_full_disk_is_one_line_for_every_form_of_export(tmp_path, form):
    pytest.importorskip("h5py", reason="needs the extra hloc")
    database = Database.create(tmp_path / "db", width=480)
    database.append([f"a/{n}" for n in range(9)], descriptors(0, 9))
    with limited(resource.RLIMIT_FSIZE, 4000), pytest.raises(OSError) as refusal:
        export_database(database, form, tmp_path / "out")
    assert "\n" not in str(refusal.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["db"]
