"""Encoding: all that can be encoded is, once, in order, and what cannot is named."""

import errno
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from drawings import VOID
from helpers import street, write_street
from PIL import Image

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.label_files import digest, find_label_files
from ssrvlad_torch.encoding import encoder as encoding
from ssrvlad_torch.encoding.encoder import encode_to_database, encode_to_memory

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


@pytest.fixture
def maps(tmp_path):
    """Folders of label maps; write more with `add`."""
    return Maps(tmp_path)


class Maps:
    def __init__(self, folder):
        self.folder = folder

    def add(self, sequence, numbers, height=24, width=32):
        for number in numbers:
            write_street(self.folder / sequence / f"{number}.png", number, height, width)

    def write(self, frame, labels):
        path = self.folder / f"{frame}.png"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(labels).save(path)

    def files(self):
        return find_label_files([str(self.folder / "[ab]")])

    def database(self):
        return Database.open_or_create(self.folder / "town.ssrdb", HEAD.config)

    def encode(self, **options):
        return encode_to_database(HEAD, self.files(), self.database(), **options)


def alone(labels):
    return HEAD(torch.from_numpy(labels)[None])[0]


def counts(summary):
    return summary.encoded, summary.already_there, len(summary.refused)


def test_every_frame_is_what_the_head_makes_of_it_alone(maps):
    maps.add("a", range(20))
    maps.add("b", range(3))
    (maps.folder / "poses.csv").write_text("frame,x,y,heading\na/3,1,2,0.5\n")
    assert counts(maps.encode()) == (23, 0, 0)
    frames = maps.database().load()
    numbers = [*range(20), *range(3)]
    assert frames.frames == tuple(f"{'ab'[row > 19]}/{n}" for row, n in enumerate(numbers))
    for descriptor, number in zip(frames.descriptors, numbers, strict=True):
        assert torch.equal(descriptor, alone(street(number)))
    assert frames.poses[3].tolist() == [1, 2, 0.5]
    assert np.isnan(np.delete(frames.poses, 3, axis=0)).all()
    row = maps.database().table().to_pylist()[4]
    assert (row["sequence"], row["name"], row["labels_as"]) == ("a", "4", "camvid-11")
    assert (row["height"], row["width"], row["digest"]) == (24, 32, digest(street(4)))


def test_running_again_adds_only_what_is_missing(maps, monkeypatch):
    maps.add("a", range(5))
    assert counts(maps.encode()) == (5, 0, 0)
    before = maps.database().load()
    read = []
    whole = encoding.read_label_map
    monkeypatch.setattr(
        encoding,
        "read_label_map",
        lambda file, space: (read.append(file.name), whole(file, space))[1],
    )
    assert counts(maps.encode()) == (0, 5, 0)
    assert read == []
    maps.add("a", [20, 3000])
    assert counts(maps.encode()) == (2, 5, 0)
    assert sorted(read) == ["20", "3000"]
    after = maps.database().load()
    assert after.frames == (*before.frames, "a/20", "a/3000")
    assert torch.equal(after.descriptors[:5], before.descriptors)


def test_a_frame_that_cannot_be_read_or_encoded_is_refused_and_the_rest_lands(maps):
    """Both in the middle of a batch."""
    maps.add("a", range(12))
    (maps.folder / "a" / "4.png").write_text("no image")
    unknown = street(7)
    unknown[2:4, 5:8] = 99
    maps.write("a/7", unknown)
    summary = maps.encode()
    assert counts(summary) == (10, 0, 2)
    first, second = summary.refused
    assert first.frame == "a/4"
    assert f"{maps.folder}/a/4.png: cannot identify" in first.reason
    assert second.frame == "a/7"
    assert f"{maps.folder}/a/7.png: label id 99 (6 pixels) is not in label space" in second.reason
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(12) if n not in (4, 7))
    for name, descriptor in zip(frames.frames, frames.descriptors, strict=True):
        assert torch.equal(descriptor, alone(street(int(name[2:]))))
    maps.add("a", [4])
    assert counts(maps.encode()) == (1, 10, 1), "what was mended is taken the next time"


def test_frames_of_differing_sizes_are_each_encoded_at_their_own(maps):
    sizes = [(24, 32), (30, 20), (24, 32), (130, 150), (30, 20), (24, 33)]
    for number in range(18):
        maps.add("a", [number], *sizes[number % len(sizes)])
    assert counts(maps.encode()) == (18, 0, 0)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(18)), "in the order of their names"
    assert maps.database().table(["name"])["name"].to_pylist() == [str(n) for n in range(18)]
    for number, descriptor in enumerate(frames.descriptors):
        assert torch.equal(descriptor, alone(street(number, *sizes[number % len(sizes)])))


def test_frames_of_differing_formats_are_encoded_alike(maps):
    """A label map is its ids: as gray of 8 or 16 bits or 32, as a palette image, as an array."""
    labels = street(0)
    maps.write("a/0", labels)
    maps.write("a/1", labels.astype(np.uint16))
    Image.fromarray(labels.astype(np.int32)).save(maps.folder / "a" / "2.tif")
    np.save(maps.folder / "a" / "3.npy", labels.astype(">u4"))
    assert counts(maps.encode()) == (4, 0, 0)
    frames = maps.database().load()
    for descriptor in frames.descriptors:
        assert torch.equal(descriptor, alone(labels))
    assert len(set(maps.database().digests().values())) == 1


def test_an_empty_image_is_encoded_flagged_and_zero(maps):
    maps.add("a", [0, 2])
    maps.write("a/1", np.full((24, 32), VOID, np.uint8))
    summary = maps.encode()
    assert counts(summary) == (3, 0, 0)
    assert summary.empty == 1
    frames = maps.database().load()
    assert frames.empty.tolist() == [False, True, False]
    assert not frames.descriptors[1].any()


def test_frames_land_in_parts(maps, monkeypatch):
    monkeypatch.setattr(encoding, "PART_ROWS", 4)
    maps.add("a", range(10))
    assert counts(maps.encode()) == (10, 0, 0)
    assert len(list(maps.database().path.glob("part-*.parquet"))) == 3
    assert maps.database().load().frames == tuple(f"a/{n}" for n in range(10))


@pytest.mark.parametrize("part_rows", [4, 4096])
@pytest.mark.parametrize("done", [1, 7, 18])
def test_what_was_encoded_before_ctrl_c_is_in_the_database(maps, monkeypatch, part_rows, done):
    monkeypatch.setattr(encoding, "PART_ROWS", part_rows)
    maps.add("a", range(20))
    told = []

    def interrupt(count):
        told.append(count)
        if sum(told) == done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        maps.encode(progress=interrupt)
    assert maps.database().load().frames == tuple(f"a/{n}" for n in range(done))
    assert counts(maps.encode()) == (20 - done, done, 0)
    assert maps.database().load().frames == tuple(f"a/{n}" for n in range(20))


def test_progress_counts_every_frame_once(maps):
    maps.add("a", range(3))
    maps.encode()
    maps.add("a", range(3, 9))
    (maps.folder / "a" / "5.png").write_text("no image")
    told = []
    maps.encode(progress=told.append)
    assert sum(told) == 9
    assert told[0] == 3


def test_a_full_disk_keeps_the_parts_that_landed_and_says_so(maps, monkeypatch):
    monkeypatch.setattr(encoding, "PART_ROWS", 4)
    maps.add("a", range(10))
    append, appended = Database.append, []

    def full_at_the_second(self, records, descriptors):
        appended.append(len(records))
        if len(appended) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, records, descriptors)

    with monkeypatch.context() as patch:
        patch.setattr(Database, "append", full_at_the_second)
        with pytest.raises(OSError, match="No space left"):
            maps.encode()
    assert maps.database().load().frames == ("a/0", "a/1", "a/2", "a/3")
    assert counts(maps.encode()) == (6, 4, 0)


def test_a_run_in_which_all_is_refused_leaves_a_valid_empty_database(maps):
    (maps.folder / "a").mkdir()
    for number in range(3):
        (maps.folder / "a" / f"{number}.png").write_text("no image")
    assert counts(maps.encode()) == (0, 0, 3)
    assert maps.database().load().frames == ()


def test_no_files_are_no_work(maps):
    summary = encode_to_database(HEAD, [], maps.database())
    assert counts(summary) == (0, 0, 0)


def test_another_fingerprint_is_refused_before_anything_is_read(maps):
    maps.add("a", [0])
    paper = SSRVLAD.from_preset("paper", labels_as="camvid-11")
    with pytest.raises(ValueError, match="has fingerprint"):
        encode_to_database(paper, maps.files(), maps.database())
    assert len(maps.database()) == 0


def test_another_label_space_goes_into_the_same_database(maps):
    maps.add("a", [0])
    maps.encode()
    maps.write("b/0", np.full((24, 32), 3, np.uint8))
    synthia = SSRVLAD.from_preset("default", labels_as="synthia")
    assert counts(encode_to_database(synthia, maps.files(), maps.database())) == (1, 1, 0)
    assert maps.database().table(["labels_as"])["labels_as"].to_pylist() == ["camvid-11", "synthia"]


@pytest.mark.parametrize("workers", [0, 1, 5])
def test_the_number_of_workers_does_not_show(maps, workers):
    maps.add("a", range(70, 150, 2))
    frames, refused = encode_to_memory(HEAD, maps.files(), workers)
    assert refused == []
    assert frames.frames == tuple(f"a/{n}" for n in range(70, 150, 2))
    for name, descriptor in zip(frames.frames, frames.descriptors, strict=True):
        assert torch.equal(descriptor, alone(street(int(name[2:]))))


def test_memory_and_database_hold_the_same(maps):
    maps.add("b", range(3))
    maps.add("a", range(3))
    maps.write("a/1", np.full((24, 32), VOID, np.uint8))
    (maps.folder / "b" / "1.png").write_text("no image")
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\nb/2,3,4\n")
    in_memory, refused = encode_to_memory(HEAD, maps.files())
    summary = maps.encode()
    on_disk = maps.database().load()
    assert refused == summary.refused
    assert in_memory.frames == on_disk.frames
    assert in_memory.sequences == on_disk.sequences
    assert torch.equal(in_memory.descriptors, on_disk.descriptors)
    np.testing.assert_array_equal(in_memory.poses, on_disk.poses)
    assert in_memory.empty.tolist() == on_disk.empty.tolist() == [False, True, False, False, False]


def test_nothing_in_memory_has_shapes(maps):
    (maps.folder / "a").mkdir()
    (maps.folder / "a" / "0.png").write_text("no image")
    frames, refused = encode_to_memory(HEAD, maps.files())
    assert [refusal.frame for refusal in refused] == ["a/0"]
    assert frames.descriptors.shape == (0, 480)
    assert frames.poses.shape == (0, 3)
    assert frames.empty.shape == (0,)


def test_a_stack_is_encoded_row_by_row(maps):
    np.save(maps.folder / "s.npy", np.stack([street(n) for n in range(4)]))
    files = find_label_files([str(maps.folder / "s.npy")])
    frames, _ = encode_to_memory(HEAD, files)
    assert frames.frames == tuple(f"s/s-00000{n}" for n in range(4))
    for number, descriptor in enumerate(frames.descriptors):
        assert torch.equal(descriptor, alone(street(number)))


# ---- what has changed


def rewrite(path, seed):
    """Another label map in the place of one, in a file of its own."""
    path.unlink()
    write_street(path, seed)


def test_a_changed_file_is_encoded_again_and_takes_the_place_of_the_old(maps):
    maps.add("a", range(5))
    maps.encode()
    rewrite(maps.folder / "a" / "3.png", 99)
    summary = maps.encode()
    assert (summary.encoded, summary.changed, summary.already_there) == (0, 1, 4)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(5))
    assert torch.equal(frames.descriptors[3], alone(street(99)))
    assert torch.equal(frames.descriptors[4], alone(street(4)))
    assert maps.database().digests()["a/3"] == digest(street(99))
    assert (maps.encode().changed, maps.encode().already_there) == (0, 5)


def test_a_change_that_keeps_size_and_time_is_seen(maps):
    """Its time of change is not in the user's hands."""
    path = maps.folder / "a" / "0.npy"
    path.parent.mkdir()
    np.save(path, street(0))
    maps.encode()
    before = path.stat()
    time.sleep(0.02)
    np.save(path, street(1))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert maps.encode().changed == 1
    assert torch.equal(maps.database().load().descriptors[0], alone(street(1)))


def test_a_file_that_was_only_touched_is_read_but_not_encoded(maps, monkeypatch):
    maps.add("a", range(3))
    maps.encode()
    (maps.folder / "a" / "1.png").touch()
    monkeypatch.setattr(SSRVLAD, "forward", None)
    summary = maps.encode()
    assert (summary.changed, summary.already_there) == (0, 3)


def test_a_changed_file_that_cannot_be_read_is_refused_and_its_row_stays(maps):
    maps.add("a", range(3))
    maps.encode()
    (maps.folder / "a" / "1.png").write_text("no image")
    summary = maps.encode()
    assert counts(summary) == (0, 2, 1)
    assert torch.equal(maps.database().load().descriptors[1], alone(street(1)))


def test_a_changed_pose_is_taken_over(maps):
    maps.add("a", range(3))
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,4\n")
    maps.encode()
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,5\n")
    summary = maps.encode()
    assert (summary.changed, summary.already_there) == (1, 2)
    assert maps.database().load().poses[1, :2].tolist() == [3, 5]


def test_frames_whose_file_is_gone_are_told_and_removed_if_asked(maps):
    maps.add("a", range(4))
    maps.add("b", range(2))
    maps.encode()
    for number in (1, 3):
        (maps.folder / "a" / f"{number}.png").unlink()
    files = [file for file in maps.files() if file.sequence == "a"]
    assert maps.encode().gone == [], "not all files need be given"
    summary = encode_to_database(HEAD, files, maps.database(), complete=True)
    assert (summary.gone, summary.pruned) == (["a/1", "a/3"], 0)
    assert len(maps.database()) == 6
    summary = encode_to_database(HEAD, files, maps.database(), complete=True, prune=True)
    assert (summary.gone, summary.pruned) == ([], 2)
    assert maps.database().load().frames == ("a/0", "a/2", "b/0", "b/1"), "other sequences stay"
    with pytest.raises(ValueError, match="prune wants to know all files"):
        encode_to_database(HEAD, files, maps.database(), prune=True)


# ---- several at once


def test_a_second_encoder_is_refused_at_once(maps):
    maps.add("a", range(3))
    with (
        maps.database().writing(),
        pytest.raises(ValueError, match="is being written by another process"),
    ):
        maps.encode()
    assert counts(maps.encode()) == (3, 0, 0)


SCRIPT = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from ssrvlad_torch import SSRVLAD, encoding
from ssrvlad_torch import Database
from ssrvlad_torch.datasets.label_files import find_label_files
encoding.BATCH, encoding.PART_ROWS = 1, 8
head = SSRVLAD.from_preset("default", labels_as="camvid-11")
database = Database.open_or_create(sys.argv[1], head.config)
told = []
def progress(done):
    told.append(done)
    if sum(told) == 10:
        print("ready", flush=True)
    time.sleep(0.02)
encoding.encode_to_database(head, find_label_files([sys.argv[2]]), database, 2, progress)
"""


@pytest.mark.parametrize(
    ("number", "code"),
    [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 143), (signal.SIGKILL, -9)],
)
def test_a_signal_ends_a_run_and_its_workers_and_the_next_run_completes_it(maps, number, code):
    """All that was told done is there; after SIGKILL all parts that were full."""
    maps.add("a", range(60))
    target = maps.folder / "town.ssrdb"
    command = [sys.executable, "-c", SCRIPT, str(target), str(maps.folder / "a")]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert running.stdout.readline() == b"ready\n"
    running.send_signal(number)
    assert running.wait(60) in (code, 130)
    landed = len(Database.open(target))
    assert landed >= (8 if number == signal.SIGKILL else 10)
    assert landed < 60
    assert counts(maps.encode()) == (60 - landed, landed, 0)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(60))
    for row, descriptor in enumerate(frames.descriptors):
        assert torch.equal(descriptor, alone(street(row)))


STEPS = ["known", "_to_do", "_encode", "in_order", "append"]


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_no_signal_of_the_start_or_the_end_is_lost(maps, monkeypatch, step, number):
    """It comes just before a step of which none asks for signals; `append` writes the last part."""
    maps.add("a", range(40))
    owner = Database if step in ("known", "append") else encoding
    whole, come = getattr(owner, step), []

    def interrupted(*arguments, **options):
        if not come:
            come.append(number)
            signal.raise_signal(number)
        return whole(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(owner, step, interrupted)
        patch.setattr(encoding, "BATCHES_OF_A_CHUNK", 1)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with pytest.raises((KeyboardInterrupt, SystemExit)) as end:
                maps.encode(workers=2)
        finally:
            signal.signal(signal.SIGINT, before)
    assert (end.type is SystemExit) == (number == signal.SIGTERM)
    landed = len(maps.database())
    assert landed == (40 if step == "append" else 1), "what was in hand is done"
    assert counts(maps.encode()) == (40 - landed, landed, 0)


def test_a_killed_worker_is_an_error_and_what_was_done_stays(maps, monkeypatch):
    monkeypatch.setattr(encoding, "BATCH", 2)
    maps.add("a", range(40))
    read = encoding.read_label_map

    def die(file, space):
        if file.name == "30":
            os.kill(os.getpid(), signal.SIGKILL)
        return read(file, space)

    with monkeypatch.context() as patch:
        patch.setattr(encoding, "read_label_map", die)
        with pytest.raises(ChildProcessError, match="a worker process was killed"):
            maps.encode(workers=2)
    landed = len(maps.database())
    assert landed <= 30
    assert counts(maps.encode()) == (40 - landed, landed, 0)
