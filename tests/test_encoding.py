"""Encoding: every readable frame is encoded once, in order; the others are skipped and reported."""

import errno
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
import yaml
from drawings import VOID
from helpers import street, write_street
from PIL import Image

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.label_files import digest, find_label_files
from ssrvlad_torch.encoding import describer, writer
from ssrvlad_torch.encoding.encoder import encode_to_database, encode_to_memory
from ssrvlad_torch.encoding.results import EncodeOptions

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

    def files(self, *folders, **options):
        folders = [str(self.folder / folder) for folder in folders or ("[ab]",)]
        return find_label_files(folders, **options)

    def database(self):
        return Database.open_or_create(self.folder / "town.ssrdb", HEAD.config)

    def encode(self, *folders, head=HEAD, **options):
        files = self.files(*folders)
        return encode_to_database(head, files, self.database(), EncodeOptions(**options))


def alone(labels):
    return HEAD(torch.from_numpy(labels)[None])[0]


def counts(summary):
    return summary.encoded, summary.already_there, len(summary.skipped)


def test_descriptors_equal_those_of_single_frames(maps):
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
    record = maps.database().known()["a/4"]
    assert (record.height, record.width, record.digest) == (24, 32, digest(street(4)))


def test_a_frame_that_cannot_be_read_or_encoded_is_skipped_and_the_others_are_encoded(maps):
    """Both in the middle of a batch."""
    maps.add("a", range(12))
    (maps.folder / "a" / "4.png").write_text("no image")
    unknown = street(7)
    unknown[2:4, 5:8] = 99
    maps.write("a/7", unknown)
    reported = []
    summary = maps.encode(skipped=reported.append)
    assert counts(summary) == (10, 0, 2)
    assert reported == summary.skipped
    first, second = summary.skipped
    assert first.frame == "a/4"
    assert f"{maps.folder}/a/4.png: cannot identify" in first.reason
    assert second.frame == "a/7"
    assert f"{maps.folder}/a/7.png: label id 99 (6 pixels) is not in label space" in second.reason
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(12) if n not in (4, 7))
    for name, descriptor in zip(frames.frames, frames.descriptors, strict=True):
        assert torch.equal(descriptor, alone(street(int(name[2:]))))
    maps.add("a", [4])
    assert counts(maps.encode()) == (1, 10, 1), "a repaired file is encoded in the next run"


def test_frames_may_differ_in_size_and_format(maps):
    """Ids in gray images of 8, 16 and 32 bits, and in an array."""
    sizes = [(24, 32), (30, 20), (24, 32), (130, 150), (24, 33)]
    for number in range(10):
        maps.add("a", [number], *sizes[number % len(sizes)])
    labels = street(0)
    maps.write("a/10", labels.astype(np.uint16))
    Image.fromarray(labels.astype(np.int32)).save(maps.folder / "a" / "11.tif")
    np.save(maps.folder / "a" / "12.npy", labels.astype(">u4"))
    assert counts(maps.encode()) == (13, 0, 0)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(13)), "in natural order"
    for number, descriptor in enumerate(frames.descriptors[:10]):
        assert torch.equal(descriptor, alone(street(number, *sizes[number % len(sizes)])))
    known = maps.database().known()
    for number in (10, 11, 12):
        assert torch.equal(frames.descriptors[number], alone(labels))
        assert known[f"a/{number}"].digest == known["a/0"].digest


def test_an_empty_image_has_a_zero_descriptor_and_a_flag(maps):
    maps.add("a", [0, 2])
    maps.write("a/1", np.full((24, 32), VOID, np.uint8))
    summary = maps.encode()
    assert counts(summary) == (3, 0, 0)
    assert summary.empty == 1
    frames = maps.database().load()
    assert frames.empty.tolist() == [False, True, False]
    assert not frames.descriptors[1].any()


def test_unreadable_frames_alone_leave_a_valid_empty_database(maps):
    (maps.folder / "a").mkdir()
    for number in range(3):
        (maps.folder / "a" / f"{number}.png").write_text("no image")
    assert counts(maps.encode()) == (0, 0, 3)
    assert maps.database().load().frames == ()
    assert counts(encode_to_database(HEAD, [], maps.database())) == (0, 0, 0)
    frames, skipped = encode_to_memory(HEAD, maps.files())
    assert len(skipped) == 3
    assert frames.descriptors.shape == (0, 480)
    assert frames.poses.shape == (0, 3)


def test_memory_and_database_hold_the_same_frames(maps):
    maps.add("b", range(3))
    maps.add("a", range(3))
    (maps.folder / "b" / "1.png").write_text("no image")
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\nb/2,3,4\n")
    in_memory, skipped = encode_to_memory(HEAD, maps.files())
    summary = maps.encode()
    on_disk = maps.database().load()
    assert skipped == summary.skipped
    assert in_memory.frames == on_disk.frames
    assert in_memory.sequences == on_disk.sequences
    assert torch.equal(in_memory.descriptors, on_disk.descriptors)
    np.testing.assert_array_equal(in_memory.poses, on_disk.poses)
    assert in_memory.empty.tolist() == on_disk.empty.tolist()


def test_a_stack_is_encoded_row_by_row(maps):
    np.save(maps.folder / "s.npy", np.stack([street(n) for n in range(4)]))
    frames, _ = encode_to_memory(HEAD, maps.files("s.npy"))
    assert frames.frames == tuple(f"s/s-00000{n}" for n in range(4))
    for number, descriptor in enumerate(frames.descriptors):
        assert torch.equal(descriptor, alone(street(number)))


def test_another_fingerprint_is_refused_before_anything_is_read(maps):
    maps.add("a", [0])
    maps.database()
    paper = SSRVLAD.from_preset("paper", labels_as="camvid-11")
    with pytest.raises(ValueError, match="has fingerprint"):
        encode_to_database(paper, maps.files(), maps.database())


# ---- new frames, and frames that are encoded again


@pytest.fixture
def reads(monkeypatch):
    """Names of the frames that are read."""
    names, whole = [], describer.read_label_map
    spy = lambda file, space: (names.append(file.name), whole(file, space))[1]  # noqa: E731
    monkeypatch.setattr(describer, "read_label_map", spy)
    return names


def test_running_again_reads_only_what_is_missing(maps, reads):
    maps.add("a", range(5))
    assert counts(maps.encode()) == (5, 0, 0)
    reads.clear()
    assert counts(maps.encode()) == (0, 5, 0)
    assert reads == []
    maps.add("a", [20, 3000])
    assert counts(maps.encode()) == (2, 5, 0)
    assert sorted(reads) == ["20", "3000"]


def test_another_label_space_encodes_all_frames_again(maps):
    maps.add("a", range(5))
    maps.encode()
    synthia = SSRVLAD.from_preset("default", labels_as="synthia")
    summary = maps.encode(head=synthia)
    assert summary.anew == {"label space changed": 5}
    assert str(summary) == (
        "0 frames encoded (0 of them empty), 5 encoded anew: label space changed, "
        "0 already there, 0 skipped"
    )
    frames = maps.database().load()
    assert torch.equal(frames.descriptors[2], synthia(torch.from_numpy(street(2))[None])[0])
    assert counts(maps.encode(head=synthia)) == (0, 5, 0)
    assert maps.encode().anew == {"label space changed": 5}


def test_a_changed_label_space_of_the_same_name_encodes_frames_again(maps):
    maps.add("a", range(3))
    classes = [{"id": n, "name": str(n), "category": "ground"} for n in range(12)]
    path = maps.folder / "mine.yaml"

    def head():
        text = yaml.safe_dump({"name": "mine", "source": "me", "classes": classes})
        path.write_text(text, encoding="utf-8")
        return SSRVLAD.from_preset("default", labels_as=str(path))

    assert maps.encode(head=head()).encoded == 3
    assert counts(maps.encode(head=head())) == (0, 3, 0)
    classes[4]["category"] = "sky"
    before = maps.database().load().descriptors
    assert maps.encode(head=head()).anew == {"label space changed": 3}
    assert not torch.equal(maps.database().load().descriptors, before)


def rewrite(path, seed):
    """Replaces a label map by another, in a new file."""
    path.unlink()
    write_street(path, seed)


def test_a_changed_file_is_encoded_again_and_replaces_the_row(maps):
    maps.add("a", range(5))
    maps.encode()
    rewrite(maps.folder / "a" / "3.png", 99)
    summary = maps.encode()
    assert (summary.encoded, summary.anew, summary.already_there) == (0, {"file changed": 1}, 4)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(5))
    assert torch.equal(frames.descriptors[3], alone(street(99)))
    assert maps.database().known()["a/3"].digest == digest(street(99))
    assert maps.encode().already_there == 5


def test_a_change_that_keeps_size_and_modification_time_is_noticed(maps):
    """A user cannot set the time of the inode's last change."""
    path = maps.folder / "a" / "0.npy"
    path.parent.mkdir()
    np.save(path, street(0))
    maps.encode()
    before = path.stat()
    time.sleep(0.02)
    np.save(path, street(1))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert maps.encode().anew == {"file changed": 1}
    assert torch.equal(maps.database().load().descriptors[0], alone(street(1)))


def test_a_touched_file_is_read_once(maps, reads):
    maps.add("a", range(3))
    maps.encode()
    (maps.folder / "a" / "1.png").touch()
    reads.clear()
    assert maps.encode().anew == {"file touched, the same label map": 1}
    assert maps.encode().already_there == 3
    assert reads == ["1"]


def test_a_changed_file_that_cannot_be_read_is_skipped_and_its_row_stays(maps):
    maps.add("a", range(3))
    maps.encode()
    (maps.folder / "a" / "1.png").write_text("no image")
    assert counts(maps.encode()) == (0, 2, 1)
    assert torch.equal(maps.database().load().descriptors[1], alone(street(1)))


def test_a_changed_pose_is_stored(maps):
    maps.add("a", range(3))
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,4\n")
    maps.encode()
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,5\n")
    summary = maps.encode()
    assert (summary.anew, summary.already_there) == ({"pose changed": 1}, 2)
    assert maps.database().load().poses[1, :2].tolist() == [3, 5]
    (maps.folder / "poses.csv").unlink()
    (maps.folder / "a" / "1.png").touch()
    assert maps.encode().anew.total() == 1
    assert maps.database().load().poses[1, :2].tolist() == [3, 5], "no table says anything else"
    (maps.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\n")
    assert maps.encode().anew == {"pose changed": 1}
    assert np.isnan(maps.database().load().poses[:, 0]).tolist() == [False, True, True]


def test_frames_whose_file_is_gone_are_reported_and_removed_with_prune(maps):
    maps.add("a", range(4))
    maps.add("b", range(2))
    maps.encode()
    for number in (1, 3):
        (maps.folder / "a" / f"{number}.png").unlink()
    assert maps.encode().gone == [], "the files need not be complete"
    summary = maps.encode("a", complete=True)
    assert (summary.gone, summary.pruned) == (["a/1", "a/3"], 0)
    assert len(maps.database()) == 6
    summary = maps.encode("a", complete=True, prune=True)
    assert (summary.gone, summary.pruned) == ([], 2)
    assert maps.database().load().frames == ("a/0", "a/2", "b/0", "b/1"), "other sequences stay"
    with pytest.raises(ValueError, match="prune needs all files"):
        EncodeOptions(prune=True)


# ---- folders with the same name


def test_folders_with_the_same_name_are_distinguished_in_one_run_and_in_several(maps):
    for drive in ("00", "01", "02"):
        maps.add(f"{drive}/labels", [int(drive), 7])
    maps.encode("00/labels", "01/labels")
    assert maps.database().load().frames == tuple(
        f"0{d}/labels/{n}" for d in "01" for n in (int(d), 7)
    )
    known = maps.database().folders()
    files = maps.files("02/labels", known=known)
    assert encode_to_database(HEAD, files, maps.database()).encoded == 2
    assert {file.sequence for file in files} == {"02/labels"}
    files = maps.files("02/labels", "00/labels", known=maps.database().folders())
    options = EncodeOptions(complete=True, prune=True)
    summary = encode_to_database(HEAD, files, maps.database(), options)
    assert (counts(summary), summary.pruned) == ((0, 4, 0), 0)
    assert len(maps.database()) == 6


def test_another_folder_with_the_same_name_never_merges_overwrites_or_prunes(maps):
    maps.add("00/labels", range(3))
    maps.add("01/labels", range(2, 5))
    maps.encode("00/labels")
    before = maps.database().load()
    with pytest.raises(ValueError, match=r"'labels' of the database is .*00/labels, not .*01"):
        maps.encode("01/labels", complete=True, prune=True)
    files = maps.files("01/labels", sequence="labels")
    with pytest.raises(ValueError, match=r"frame 'labels/2' of the database is of .*00/labels"):
        encode_to_database(HEAD, files, maps.database())
    assert torch.equal(maps.database().load().descriptors, before.descriptors)
    files = maps.files("01/labels", known=maps.database().folders())
    assert {file.sequence for file in files} == {"01/labels"}
    assert encode_to_database(HEAD, files, maps.database()).encoded == 3
    maps.add("02/labels", range(3, 5))
    files = maps.files("02/labels", sequence="labels")
    assert encode_to_database(HEAD, files, maps.database()).encoded == 2, "the user gave the name"


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        (None, "'labels' of the database is .*01/labels, not .*00/labels"),
        ("labels", "frame 'labels/2' of the database is of .*01/labels, not of .*00/labels"),
    ],
)
def test_folders_that_take_the_same_name_at_once_do_not_merge(maps, sequence, message):
    """The other run begins after the plan of this one, and ends before its first commit."""
    maps.add("00/labels", range(3))
    maps.add("01/labels", range(2, 5))

    def other(_done):
        if not len(maps.database()):
            files = maps.files("01/labels", sequence=sequence)
            assert encode_to_database(HEAD, files, maps.database()).encoded == 3

    files = maps.files("00/labels", sequence=sequence)
    with pytest.raises(ValueError, match=message):
        encode_to_database(HEAD, files, maps.database(), EncodeOptions(progress=other))
    assert maps.database().load().frames == tuple(f"labels/{n}" for n in range(2, 5))


def test_a_file_is_not_stored_under_two_names(maps):
    maps.add("a", range(3))
    maps.encode()
    files = maps.files("a", sequence="new")
    options = EncodeOptions(complete=True, prune=True)
    expected = r"a/0\.png is frame 'a/0' of the database: expected --sequence a, got new"
    with pytest.raises(ValueError, match=expected):
        encode_to_database(HEAD, files, maps.database(), options)
    assert len(maps.database()) == 3
    maps.add("a", range(3, 5))
    files = [file for file in maps.files("a", sequence="new") if file.name in "34"]
    assert encode_to_database(HEAD, files, maps.database()).encoded == 2


def test_a_stack_beside_a_folder_of_its_name_is_another_sequence(maps):
    maps.add("day", range(3))
    maps.encode("day")
    np.save(maps.folder / "day.npy", np.stack([street(seed) for seed in range(4)]))
    with pytest.raises(ValueError, match="needs a name"):
        maps.files("day", "day.npy")
    files = maps.files("day.npy", sequence="stack")
    options = EncodeOptions(complete=True, prune=True)
    assert encode_to_database(HEAD, files, maps.database(), options).encoded == 4
    assert maps.encode("day", complete=True, prune=True).pruned == 0
    assert len(maps.database()) == 7


def test_a_moved_folder_continues_its_sequence_if_the_name_is_given(maps):
    maps.add("a", range(3))
    maps.encode()
    (maps.folder / "other").mkdir()
    (maps.folder / "a").rename(maps.folder / "other" / "a")
    known = maps.database().folders()
    with pytest.raises(
        ValueError, match=r"'a' of the database was encoded from .*, which is gone: .*--sequence a"
    ):
        maps.files("other/a", known=known)
    files = maps.files("other/a", sequence="a", known=known)
    assert encode_to_database(HEAD, files, maps.database()).anew == {"file moved": 3}
    assert counts(encode_to_database(HEAD, files, maps.database())) == (0, 3, 0)


# ---- commits, workers and signals


def test_frames_are_committed_after_a_number_of_rows_and_after_a_time(maps, monkeypatch):
    monkeypatch.setattr(writer, "COMMIT_ROWS", 4)
    maps.add("a", range(10))
    before = maps.database().version
    assert counts(maps.encode()) == (10, 0, 0)
    assert maps.database().version == before + 4, "the origin, and 4, 4 and 2 frames"
    monkeypatch.setattr(writer, "COMMIT_SECONDS", -1)
    maps.add("b", range(2))
    maps.encode()
    assert maps.database().version == before + 6


@pytest.mark.parametrize("rows", [4, 8192])
@pytest.mark.parametrize("done", [1, 7, 18])
def test_frames_encoded_before_an_interruption_are_in_the_database(maps, monkeypatch, rows, done):
    monkeypatch.setattr(writer, "COMMIT_ROWS", rows)
    maps.add("a", range(20))
    counted = []

    def interrupt(count):
        counted.append(count)
        if sum(counted) == done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        maps.encode(progress=interrupt)
    assert maps.database().load().frames == tuple(f"a/{n}" for n in range(done))
    counted.clear()
    assert counts(maps.encode(progress=counted.append)) == (20 - done, done, 0)
    assert counted == [done] + [1] * (20 - done), "progress counts every frame once"


def test_a_full_disk_is_an_error_and_committed_frames_stay(maps, monkeypatch):
    monkeypatch.setattr(writer, "COMMIT_ROWS", 4)
    maps.add("a", range(10))
    merge, merged = Database.merge, []

    def fail_at_the_second(self, records, *descriptors):
        merged.append(len(records))
        if len(merged) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        merge(self, records, *descriptors)

    with monkeypatch.context() as patch:
        patch.setattr(Database, "merge", fail_at_the_second)
        with pytest.raises(OSError, match="No space left"):
            maps.encode()
    assert maps.database().load().frames == ("a/0", "a/1", "a/2", "a/3")
    assert counts(maps.encode()) == (6, 4, 0)


def test_workers_make_the_same_rows(maps):
    threads = torch.get_num_threads()
    maps.add("a", range(70, 110))
    (maps.folder / "a" / "75.png").write_text("no image")
    frames, skipped = encode_to_memory(HEAD, maps.files(), workers=2)
    assert [frame.frame for frame in skipped] == ["a/75"]
    assert frames.frames == tuple(f"a/{n}" for n in range(70, 110) if n != 75)
    for name, descriptor in zip(frames.frames, frames.descriptors, strict=True):
        assert torch.equal(descriptor, alone(street(int(name[2:]))))
    assert torch.get_num_threads() == threads


def test_two_encoders_at_once_lose_nothing(maps):
    """Both encode all frames; none is stored twice."""
    maps.add("a", range(14))
    maps.database()
    command = [sys.executable, "-c", SCRIPT, maps.folder / "town.ssrdb", maps.folder / "a", "0"]
    running = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [process.wait(120) for process in running] == [0, 0]
    assert maps.database().load().frames == tuple(f"a/{n}" for n in range(14))


SCRIPT = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from ssrvlad_torch import SSRVLAD, Database, EncodeOptions, encode_to_database
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


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, -signal.SIGINT), (signal.SIGKILL, -9)]
)
def test_a_signal_ends_a_run_and_the_next_run_completes_it(maps, number, code):
    """Frames reported by progress are stored; after SIGKILL, committed frames."""
    maps.add("a", range(60))
    target = maps.folder / "town.ssrdb"
    command = [sys.executable, "-c", SCRIPT, target, maps.folder / "a", "2"]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert running.stdout.readline() == b"ready\n"
    running.send_signal(number)
    running.communicate(timeout=60)  # no worker holds the pipes open
    assert running.returncode in (code, 130)
    stored = len(Database.open(target))
    assert stored >= (8 if number == signal.SIGKILL else 10)
    assert stored < 60
    assert counts(maps.encode()) == (60 - stored, stored, 0)
    frames = maps.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(60))
    for row, descriptor in enumerate(frames.descriptors):
        assert torch.equal(descriptor, alone(street(row)))
