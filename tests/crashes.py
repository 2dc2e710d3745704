"""Kills a writer at every call that changes the database, or at random moments; see
`test_crashes.py`. To be run with ``crashing.c`` preloaded: ``crashes.py SHIM FOLDER every N`` for
every N-th call, or ``random N`` for N moments.

For every place the writer is a fork of this process, so that nothing is imported twice.
"""

from __future__ import annotations

import ctypes
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import torch
from helpers import street, write_street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.database.storage.verification import verify
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding import encoder as encoding
from ssrvlad_torch.encoding.encoder import encode_to_database

FRAMES, CHANGED, GONE = 11, 1, "99"
HEAD = SSRVLAD.from_preset("paper", labels_as="camvid-11")


class Scene:
    """Frames on disk, and a database that has some of them as they once were."""

    def __init__(self, folder: Path) -> None:
        self.database, self.before = folder / "db", folder / "before"
        for number in [*range(4), int(GONE)]:
            write_street(folder / "a" / f"{number}.png", 100 if number == CHANGED else number)
        self.files = find_label_files([str(folder / "a")])
        encode_to_database(HEAD, self.files, Database.create(self.before, HEAD.config), 0)
        (folder / "a" / f"{GONE}.png").unlink()
        for number in range(FRAMES):
            if number not in (0, 2):
                write_street(folder / "a" / f"{number}.png", number)
        self.files = find_label_files([str(folder / "a")])
        numbers = [*range(FRAMES), 100, int(GONE)]
        self.vectors = {
            number: HEAD(torch.from_numpy(street(number))[None])[0] for number in numbers
        }
        self.restore(from_nothing=False)
        self.run()
        self.rows = self.loaded()

    def restore(self, from_nothing: bool) -> None:
        shutil.rmtree(self.database, ignore_errors=True)
        if not from_nothing:
            shutil.copytree(self.before, self.database)

    def run(self, told: int | None = None) -> None:
        """The writer; tells which frames it was told are on the disk."""
        database = Database.open_or_create(self.database, HEAD.config)
        whole = Database._commit

        def commit(self, parts, new):
            whole(self, parts, new)
            if told is not None:
                os.write(told, f"{' '.join(self.digests())}\n".encode())

        Database._commit = commit
        encode_to_database(HEAD, self.files, database, 0, complete=True, prune=True)
        Database._commit = whole

    def loaded(self) -> dict[str, bytes]:
        frames = Database.open(self.database).load()
        return dict(zip(frames.frames, map(bytes, frames.descriptors.numpy()), strict=True))

    def check(self, committed: set[str], from_nothing: bool) -> None:
        """After a crash: what is there is right, what was reported is there, and a second run
        completes it."""
        rows: dict[str, bytes] = {}
        if Database.exists(self.database):
            rows = self.loaded()
            assert verify(self.database) == []
        else:
            assert from_nothing
        assert committed - {f"a/{GONE}"} <= set(rows), "what was reported is there"
        for frame, row in rows.items():
            number = int(frame.removeprefix("a/"))
            allowed = {number, 100 if number == CHANGED and not from_nothing else number}
            assert row in {bytes(self.vectors[n].numpy()) for n in allowed}, frame
        if not from_nothing:
            assert {"a/0", "a/1", "a/2", "a/3"} <= set(rows), "nothing that was there is lost"
        self.run()
        assert self.loaded() == self.rows
        named = {part.file for part in Database.open(self.database)._manifest.parts}
        with Database.open(self.database).writing():
            pass
        there = {entry.name for entry in self.database.iterdir()}
        assert there == named | {"lock", "manifest.json"}, there


def crash(scene: Scene, shim: ctypes.CDLL, at: int, after: float, from_nothing: bool) -> bool:
    """One writer, killed at a call or after some seconds; whether it was killed."""
    scene.restore(from_nothing)
    reading, telling = os.pipe()
    child = os.fork()
    if not child:
        status = 1
        try:
            shim.crash_at(at, str(scene.database).encode())
            scene.run(telling)
            status = 0
        finally:
            os._exit(status)
    os.close(telling)
    if after:
        time.sleep(after)
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with os.fdopen(reading) as told:
        committed = set("".join([*told][-1:]).split())
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the writer failed"
    scene.check(committed, from_nothing)
    return os.WIFSIGNALED(status)


def every(scene: Scene, shim: ctypes.CDLL, step: int) -> None:
    for from_nothing in (True, False):
        at, killed = 1, 0
        while crash(scene, shim, at, 0, from_nothing):
            at, killed = at + step, killed + 1
        print(killed)


def at_random(scene: Scene, shim: ctypes.CDLL, count: int) -> None:
    generator, began = random.Random(0), time.perf_counter()
    scene.restore(from_nothing=False)
    scene.run()
    whole, killed = time.perf_counter() - began, 0
    while killed < count:
        killed += crash(scene, shim, 0, generator.uniform(0.001, whole), killed % 2 == 0)
    print(killed)


def main() -> None:
    shim, folder, kind, number = ctypes.CDLL(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:]
    torch.set_num_threads(1)
    encoding.PART_ROWS = 4
    {"every": every, "random": at_random}[kind](Scene(folder), shim, int(number))


if __name__ == "__main__":
    np.seterr(all="raise")
    main()
