"""When encoded frames are committed, also after an error or a signal."""

import errno
import signal
import subprocess
import sys

import pytest
from maps import assert_streets, counts

from ssrvlad_torch.database.database import Database
from ssrvlad_torch.encoding import writer


def test_frames_are_committed_after_a_number_of_rows_and_after_a_time(town, monkeypatch):
    monkeypatch.setattr(writer, "COMMIT_ROWS", 4)
    town.add("a", range(10))
    before = town.database().version
    assert counts(town.encode()) == (10, 0, 0)
    assert town.database().version == before + 4, "the origin, and 4, 4 and 2 frames"
    monkeypatch.setattr(writer, "COMMIT_SECONDS", -1)
    town.add("b", range(2))
    town.encode()
    assert town.database().version == before + 6


@pytest.mark.parametrize("rows", [4, 8192])
@pytest.mark.parametrize("done", [1, 7, 18])
def test_frames_encoded_before_an_interruption_are_in_the_database(town, monkeypatch, rows, done):
    monkeypatch.setattr(writer, "COMMIT_ROWS", rows)
    town.add("a", range(20))
    counted = []

    def interrupt(count):
        counted.append(count)
        if sum(counted) == done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        town.encode(progress=interrupt)
    assert town.database().load().frames == tuple(f"a/{n}" for n in range(done))
    counted.clear()
    assert counts(town.encode(progress=counted.append)) == (20 - done, done, 0)
    assert counted == [done] + [1] * (20 - done), "progress counts every frame once"


def test_a_full_disk_is_an_error_and_committed_frames_stay(town, monkeypatch):
    monkeypatch.setattr(writer, "COMMIT_ROWS", 4)
    town.add("a", range(10))
    merge, merged = Database.merge, []

    def fail_at_the_second(self, records, *descriptors):
        merged.append(len(records))
        if len(merged) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        merge(self, records, *descriptors)

    with monkeypatch.context() as patch:
        patch.setattr(Database, "merge", fail_at_the_second)
        with pytest.raises(OSError, match="No space left"):
            town.encode()
    assert town.database().load().frames == ("a/0", "a/1", "a/2", "a/3")
    assert counts(town.encode()) == (6, 4, 0)


SCRIPT = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from ssrvlad_torch import SSRVLAD, Database
from ssrvlad_torch.encoding.results import EncodeOptions
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding import describer, encoder, writer
describer.BATCH, encoder.BATCH, writer.COMMIT_ROWS = 1, 1, 8
head = SSRVLAD.from_preset("default", labels_as="camvid-11")
database = Database.open_or_create(sys.argv[1], head.config)
counted = []
def progress(done):
    counted.append(done)
    if sum(counted) == 10:
        print("ready", flush=True)
    time.sleep(0.02)
options = EncodeOptions(workers=int(sys.argv[3]), progress=progress)
encode_to_database(head, find_label_files([sys.argv[2]]), database, options)
"""


def started(town, workers):
    """A process that encodes, and prints ``ready`` when 10 frames are done."""
    command = [sys.executable, "-c", SCRIPT, town.folder / "town.ssrdb", town.folder / "a", workers]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_two_encoders_at_once_lose_nothing(town):
    """Both encode all frames; none is stored twice."""
    town.add("a", range(14))
    town.database()
    running = [started(town, "0") for _ in range(2)]
    assert [process.wait(120) for process in running] == [0, 0]
    assert town.database().load().frames == tuple(f"a/{n}" for n in range(14))


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGKILL, -9)]
)
def test_a_signal_ends_a_run_and_the_next_run_completes_it(town, number, code):
    """Frames reported by progress are stored; after SIGKILL, committed frames."""
    town.add("a", range(60))
    running = started(town, "2")
    assert running.stdout.readline() == b"ready\n"
    running.send_signal(number)
    running.communicate(timeout=60)  # no worker holds the pipes open
    assert running.returncode in (code, 130)
    stored = len(town.database())
    assert stored >= (8 if number == signal.SIGKILL else 10)
    assert stored < 60
    assert counts(town.encode()) == (60 - stored, stored, 0)
    frames = town.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(60))
    assert_streets(frames, range(60))
