"""Kills a writer at system calls, or lets its calls fail; see `test_crashes.py`.

Run with ``crashing.c`` preloaded: ``crashes.py SHIM FOLDER PART N ...``. Parts: ``every N`` kills
at every N-th call that changes the database, ``fail N`` lets every N-th call fail; both print the
number of disturbed writers. ``record 0`` prints the calls of one `merge`. ``--`` separates the
output of parts.

Every writer and every check of its database is a fork of this process, which imports Lance but does
not use it: its threads would not survive the fork.
"""

import ctypes
import errno
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import lance.commit
import lance.optimize  # noqa: F401
import torch
from helpers import descriptors

from ssrvlad_torch import Database

WIDTH = 6
KEPT, OLD, NEW = ["a/0", "a/1", "a/2"], descriptors(0, 3, WIDTH), descriptors(1, 3, WIDTH)
MORE = [f"b/{number}" for number in range(3)]
NOT_REACHED = 3


def work(path: Path, report: int) -> None:
    """Adds, replaces, removes and compacts; writes a byte to ``report`` after each change."""
    if not Database.exists(path):
        Database.create(path, width=WIDTH)
    database = Database.open(path)
    there = set(database.known())
    if not there & set(KEPT):
        database.append(KEPT, OLD)
    os.write(report, b"1")
    database.merge(MORE, NEW)
    os.write(report, b"2")
    database.merge(KEPT[:1], NEW[:1])
    os.write(report, b"3")
    database.remove([KEPT[1]])
    os.write(report, b"4")
    database.compact(keep_days=0)
    os.write(report, b"5")


def check(path: Path, steps: int) -> None:
    """After a crash: reported changes are stored, no change is partial, and work can go on."""
    if Database.exists(path):
        assert Database.open(path).damage() == []
        frames = Database.open(path).load()
        rows = dict(zip(frames.frames, frames.descriptors, strict=True))
    else:
        rows = {}
    assert steps == 0 or {"a/0", "a/2"} <= set(rows), "reported changes are stored"
    assert not set(KEPT) & set(rows) or {"a/0", "a/2"} <= set(rows), "an append is whole or absent"
    assert len(set(MORE) & set(rows)) in ((3,) if steps >= 2 else (0, 3))
    assert steps < 3 or torch.equal(rows["a/0"], NEW[0])
    assert steps < 4 or "a/1" not in rows
    for frame, row in rows.items():
        allowed = [OLD, NEW] if frame == "a/0" else [OLD] if frame in KEPT else [NEW]
        assert any(torch.equal(row, numbers[int(frame[-1])]) for numbers in allowed), frame
    with Path(os.devnull).open("w") as null:
        work(path, null.fileno())
    frames = Database.open(path).load()
    assert frames.frames == ("a/0", "a/2", *MORE)
    assert torch.equal(frames.descriptors, torch.cat([NEW[:1], OLD[2:], NEW]))


def forked(action: Callable[[], None]) -> int:
    """Starts an action in a forked process, and returns its id."""
    child = os.fork()
    if not child:
        status = 1
        try:
            action()
            status = 0
        except Exception:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    return child


def crash(path: Path, shim: ctypes.CDLL, at: int, error: int = 0) -> bool:
    """Kills a writer at a call, or lets the call fail; whether the writer came so far."""
    shutil.rmtree(path, ignore_errors=True)
    reading, writing = os.pipe()

    def write() -> None:
        shim.fail_with(error)
        shim.crash_at(at, str(path).encode())
        try:
            work(path, writing)
        except OSError as refusal:
            assert error and "\n" not in str(refusal), refusal
        if error and shim.calls_left() > 0:
            os._exit(NOT_REACHED)

    child = forked(write)
    os.close(writing)
    status = os.waitpid(child, 0)[1]
    with os.fdopen(reading, "rb") as report:
        steps = len(report.read())
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) in (0, NOT_REACHED), "the writer failed"
    assert os.waitpid(forked(lambda: check(path, steps)), 0)[1] == 0, (at, error, steps)
    return os.WIFSIGNALED(status) or (error > 0 and os.WEXITSTATUS(status) != NOT_REACHED)


def every(path: Path, shim: ctypes.CDLL, step: int, errors: Sequence[int] = (0,)) -> None:
    at, disturbed = 1, 0
    while crash(path, shim, at, error=errors[disturbed % len(errors)]):
        at, disturbed = at + step, disturbed + 1
    print(disturbed)


def record(path: Path, shim: ctypes.CDLL, _number: int) -> None:
    def write() -> None:
        database = Database.create(path, width=WIDTH)
        database.append(KEPT, OLD)
        shim.crash_at(0, str(path).encode())
        shim.record_to(1)
        database.merge(KEPT, NEW)

    assert os.waitpid(forked(write), 0)[1] == 0


if __name__ == "__main__":
    library, folder, *parts = sys.argv[1:]
    fail = partial(every, errors=(errno.ENOSPC, errno.EIO, errno.EMFILE))
    acts = {"every": every, "fail": fail, "record": record}
    for part, (kind, number) in enumerate(zip(parts[::2], parts[1::2], strict=True)):
        print(end="--\n" if part else "", flush=True)
        target = Path(folder, kind)
        target.mkdir(exist_ok=True)
        acts[kind](target / "db", ctypes.CDLL(library), int(number))
