"""What a run encodes again, which folder a sequence is of, and when frames are committed."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from helpers import HEAD, alone, assert_streets, counts, refuses, rewrite, street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.encoding import encoder, plan
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.results import EncodeOptions

PRUNE = {"complete": True, "prune": True}


@pytest.fixture
def reads(monkeypatch):
    """Names of the frames that are read."""
    names, whole = [], encoder.read_label_map
    spy = lambda file, space: (names.append(file.name), whole(file, space))[1]  # noqa: E731
    monkeypatch.setattr(encoder, "read_label_map", spy)
    return names


def test_running_again_reads_only_what_is_missing(town, reads):
    town.add("a", range(5))
    assert counts(town.encode()) == (5, 0, 0)
    reads.clear()
    assert counts(town.encode()) == (0, 5, 0)
    assert reads == []
    town.add("a", [20, 3000])
    assert counts(town.encode()) == (2, 5, 0)
    assert sorted(reads) == ["20", "3000"]


def test_another_label_space_encodes_all_frames_again(town):
    town.add("a", range(5))
    town.encode()
    synthia = SSRVLAD.from_preset("default", labels_as="synthia")
    summary = town.encode(head=synthia)
    assert summary.anew == {"label space changed": 5}
    assert str(summary) == (
        "0 frames encoded (0 of them empty), 5 encoded anew: label space changed, "
        "0 already there, 0 skipped"
    )
    frames = town.database().load()
    assert torch.equal(frames.descriptors[2], synthia(torch.from_numpy(street(2))[None])[0])
    assert counts(town.encode(head=synthia)) == (0, 5, 0)
    assert town.encode().anew == {"label space changed": 5}


def test_changed_files_are_read_again_and_replace_their_rows(town, reads):
    """A touched file is read once; of one that cannot be read the row stays."""
    town.add("a", range(5))
    town.encode()
    rewrite(town.folder / "a" / "3.png", 99)
    (town.folder / "a" / "1.png").touch()
    (town.folder / "a" / "2.png").write_text("no image")
    reads.clear()
    summary = town.encode()
    assert counts(summary) == (0, 2, 1)
    assert summary.anew == {"file changed": 1, "file touched, the same label map": 1}
    assert sorted(reads) == ["1", "2", "3"]
    frames = town.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(5))
    assert_streets(frames, [0, 1, 2, 99, 4])
    assert town.database().known()["a/3"].digest == digest(street(99))
    assert counts(town.encode()) == (0, 4, 1)


def test_a_change_that_keeps_size_and_modification_time_is_noticed(town):
    """A user cannot set the time of the inode's last change."""
    path = town.folder / "a" / "0.npy"
    path.parent.mkdir()
    np.save(path, street(0))
    town.encode()
    before = path.stat()
    time.sleep(0.02)
    np.save(path, street(1))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert town.encode().anew == {"file changed": 1}
    assert torch.equal(town.database().load().descriptors[0], alone(street(1)))


def test_a_changed_pose_is_stored(town):
    town.add("a", range(3))
    (town.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,4\n")
    town.encode()
    (town.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\na/1,3,5\n")
    summary = town.encode()
    assert (summary.anew, summary.already_there) == ({"pose changed": 1}, 2)
    assert town.database().load().poses[1, :2].tolist() == [3, 5]
    (town.folder / "poses.csv").unlink()
    (town.folder / "a" / "1.png").touch()
    assert town.encode().anew.total() == 1
    assert town.database().load().poses[1, :2].tolist() == [3, 5], "no table says anything else"
    (town.folder / "poses.csv").write_text("frame,x,y\na/0,1,2\n")
    assert town.encode().anew == {"pose changed": 1}
    assert np.isnan(town.database().load().poses[:, 0]).tolist() == [False, True, True]


def test_another_folder_with_the_same_name_never_merges_overwrites_or_prunes(town):
    town.add("00/labels", range(3))
    town.add("01/labels", range(2, 5))
    town.encode("00/labels")
    before = town.database().load()
    refuses(r"'labels' of the database is .*00/labels, not .*01", town.encode, "01/labels", **PRUNE)
    with pytest.raises(ValueError, match=r"frame 'labels/2' of the database is of .*00/labels"):
        town.encode("01/labels", sequence="labels")
    assert torch.equal(town.database().load().descriptors, before.descriptors)
    assert town.encode("01/labels", map_folders=town.database().folders()).encoded == 3
    assert {name for _, name in town.database().folders()} == {"labels", "01/labels"}
    town.add("02/labels", range(3, 5))
    assert town.encode("02/labels", sequence="labels").encoded == 2, "the user gave the name"


def test_a_refused_run_leaves_no_origin(town):
    town.add("00/labels", range(2))
    town.add("01/labels", range(2))
    town.encode("00/labels")
    synthia = SSRVLAD.from_preset("default", labels_as="synthia")
    refuses("'labels' of the database is", town.encode, "01/labels", head=synthia)
    assert [str(origin) for origin in town.database().origins.values()] == ["camvid-11"]


@pytest.mark.parametrize(
    ("sequence", "message"),
    [
        (None, "'labels' of the database is .*01/labels, not .*00/labels"),
        ("labels", "frame 'labels/2' of the database is of .*01/labels, not of .*00/labels"),
    ],
)
def test_folders_that_take_the_same_name_at_once_do_not_merge(town, sequence, message):
    """The other run begins after the plan of this one, and ends before its first commit."""
    town.add("00/labels", range(3))
    town.add("01/labels", range(2, 5))

    def other(_done):
        if not len(town.database()):
            assert town.encode("01/labels", sequence=sequence).encoded == 3

    refuses(message, town.encode, "00/labels", sequence=sequence, progress=other)
    assert town.database().load().frames == tuple(f"labels/{n}" for n in range(2, 5))


def test_a_file_is_not_stored_under_two_names(town):
    town.add("a", range(3))
    town.encode()
    expected = r"a/0\.png is frame 'a/0' of the database: expected --sequence a, got new"
    refuses(expected, town.encode, "a", **PRUNE, sequence="new")
    assert len(town.database()) == 3
    town.add("a", range(3, 5))
    files = [file for file in town.files("a", sequence="new") if file.name in "34"]
    assert encode_to_database(HEAD, files, town.database()).encoded == 2


def test_a_moved_folder_continues_its_sequence_if_the_name_is_given(town):
    town.add("a", range(3))
    town.encode()
    (town.folder / "other").mkdir()
    (town.folder / "a").rename(town.folder / "other" / "a")
    folders = town.database().folders()
    assert town.encode("other/a", sequence="a", map_folders=folders).anew == {"file moved": 3}
    assert counts(town.encode("other/a", sequence="a", map_folders=folders)) == (0, 3, 0)


def test_frames_of_a_stack_that_cannot_be_read_now_are_not_gone(town):
    town.add("a", range(2))
    stack = town.folder / "a" / "stack.npy"
    np.save(stack, np.stack([street(7)] * 3))
    town.encode("a")
    stack.write_bytes(stack.read_bytes()[:-1])
    assert town.encode("a", complete=True).gone == []
    assert counts(town.encode("a", **PRUNE)) == (0, 2, 1)
    assert len(town.database()) == 5
    np.save(stack, street(7))
    assert town.encode("a", **PRUNE).pruned == 3, "it is one frame now"


def test_frames_of_a_bag_that_cannot_be_read_now_are_not_gone(town):
    town.add("a", range(2))
    town.encode("a")
    [first, _] = town.files("a")
    bag = FrameFile("a", "a", first.path.parent, folder=first.folder, problem="half copied")
    encode_to_database(HEAD, [bag], town.database(), EncodeOptions(**PRUNE))
    assert len(town.database()) == 2


@pytest.mark.parametrize("rows", [4, 8192])
@pytest.mark.parametrize("done", [1, 7, 18])
def test_frames_encoded_before_an_interruption_are_in_the_database(town, monkeypatch, rows, done):
    monkeypatch.setattr(plan, "COMMIT_ROWS", rows)
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


def test_two_encoders_at_once_lose_nothing(town):
    """Both encode all frames; none is stored twice."""
    town.add("a", range(14))
    words = ("encode", town.folder / "a", "-o", town.database().path, "--labels-as", "camvid-11")
    command = [sys.executable, "-m", "ssrvlad_torch", *map(str, words)]
    running = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(2)]
    assert [process.wait(120) for process in running] == [0, 0]
    assert town.database().load().frames == tuple(f"a/{n}" for n in range(14))
