"""A writer that is killed at every call that changes its database, or at random moments; see
`test_crashes.py`. To be run with ``crashing.c`` preloaded: ``crashes.py SHIM FOLDER every N`` for
every N-th call, ``random N`` for N moments, ``record`` to print the calls of one `append`.

Every writer and every look at what it left is a fork of this process, which imports Lance but never
uses it: its threads would not survive the fork.
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import lance.commit
import lance.optimize  # noqa: F401
import torch
from helpers import descriptors

from ssrvlad_torch import Database

WIDTH = 6
KEPT, OLD, NEW = ["a/0", "a/1", "a/2"], descriptors(0, 3, WIDTH), descriptors(1, 3, WIDTH)
MORE = [f"b/{number}" for number in range(3)]


def work(path: Path, told: int) -> None:
    """Adds, replaces, removes and compacts; tells after each change which one is on the disk."""
    if not Database.exists(path):
        Database.create(path, width=WIDTH)
    database = Database.open(path)
    there = set(database.known())
    if not there & set(KEPT):
        database.append(KEPT, OLD)
    os.write(told, b"1")
    database.merge(MORE, NEW)
    os.write(told, b"2")
    database.merge(KEPT[:1], NEW[:1])
    os.write(told, b"3")
    database.remove([KEPT[1]])
    os.write(told, b"4")
    database.compact(keep_days=0)
    os.write(told, b"5")


def check(path: Path, steps: int) -> None:
    """After a crash: what was told is there, nothing is half done, and the rest can be done."""
    if Database.exists(path):
        assert Database.open(path).verify() == []
        frames = Database.open(path).load()
        rows = dict(zip(frames.frames, frames.descriptors, strict=True))
    else:
        rows = {}
    assert steps == 0 or {"a/0", "a/2"} <= set(rows), "what was told is there"
    assert not set(KEPT) & set(rows) or {"a/0", "a/2"} <= set(rows), "all of an append or nothing"
    assert len(set(MORE) & set(rows)) in ((3,) if steps >= 2 else (0, 3))
    assert steps < 3 or torch.equal(rows["a/0"], NEW[0])
    assert steps < 4 or "a/1" not in rows
    for frame, row in rows.items():
        allowed = [OLD, NEW] if frame == "a/0" else [OLD] if frame in KEPT else [NEW]
        assert any(torch.equal(row, numbers[int(frame[-1])]) for numbers in allowed), frame
    with Path(os.devnull).open("w") as nobody:
        work(path, nobody.fileno())
    frames = Database.open(path).load()
    assert frames.frames == ("a/0", "a/2", *MORE)
    assert torch.equal(frames.descriptors, torch.cat([NEW[:1], OLD[2:], NEW]))


def forked(action: Callable[[], None]) -> int:
    """Starts an action in a process of its own."""
    child = os.fork()
    if not child:
        status = 1
        try:
            action()
            status = 0
        finally:
            sys.stderr.flush()
            os._exit(status)
    return child


def crash(path: Path, shim: ctypes.CDLL, at: int, after: float) -> bool:
    """One writer, killed at a call or after some seconds; whether it was killed."""
    shutil.rmtree(path, ignore_errors=True)
    reading, telling = os.pipe()

    def write() -> None:
        shim.crash_at(at, str(path).encode())
        work(path, telling)

    child = forked(write)
    os.close(telling)
    if after:
        time.sleep(after)
        os.kill(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    with os.fdopen(reading, "rb") as told:
        steps = len(told.read())
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the writer failed"
    assert os.waitpid(forked(lambda: check(path, steps)), 0)[1] == 0, (at, after, steps)
    return os.WIFSIGNALED(status)


def every(path: Path, shim: ctypes.CDLL, step: int) -> None:
    at, killed = 1, 0
    while crash(path, shim, at, 0):
        at, killed = at + step, killed + 1
    print(killed)


def at_random(path: Path, shim: ctypes.CDLL, count: int) -> None:
    generator, began = random.Random(0), time.perf_counter()
    crash(path, shim, 0, 0)
    whole, killed = time.perf_counter() - began, 0
    while killed < count:
        killed += crash(path, shim, 0, generator.uniform(0.001, whole))
    print(killed)


def record(path: Path, shim: ctypes.CDLL, _number: int) -> None:
    def write() -> None:
        database = Database.create(path, width=WIDTH)
        database.append(KEPT, OLD)
        shim.crash_at(0, str(path).encode())
        shim.record_to(1)
        database.merge(KEPT, NEW)

    assert os.waitpid(forked(write), 0)[1] == 0


if __name__ == "__main__":
    library, folder, kind, number = ctypes.CDLL(sys.argv[1]), sys.argv[2], *sys.argv[3:]
    act = {"every": every, "random": at_random, "record": record}[kind]
    act(Path(folder, "db"), library, int(number))
