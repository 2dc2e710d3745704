"""Encoding: all that can be encoded is, once, in order, and what cannot is named."""

import errno

import numpy as np
import pytest
import torch
from drawings import VOID
from helpers import street, write_street
from PIL import Image

from ssrvlad_torch import SSRVLAD, encoding
from ssrvlad_torch.database import Database
from ssrvlad_torch.datasets.label_files import digest, find_label_files
from ssrvlad_torch.encoding import encode_to_database, encode_to_memory

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
