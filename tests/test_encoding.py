"""Encoding: every readable frame is encoded once, in order; the others are skipped and reported."""

import numpy as np
import pytest
import torch
from helpers import HEAD, alone, assert_streets, counts, street, touch, write_image

from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.encoding.encoder import encode_to_database, encode_to_memory

CHANNELS = [LabelShapes(HEAD)]


def test_unreadable_frames_alone_leave_a_valid_empty_database(town):
    for number in range(3):
        touch(town.folder / "a" / f"{number}.png")
    assert counts(town.encode()) == (0, 0, 3)
    assert town.database().load().frames == ()
    assert counts(encode_to_database(HEAD, [], town.database())) == (0, 0, 0)
    frames, skipped = encode_to_memory(CHANNELS, HEAD.label_space, town.files())
    assert (len(skipped), frames.descriptors.shape, frames.poses.shape) == (3, (0, 480), (0, 3))


@pytest.mark.parametrize("workers", [0, 2])
def test_memory_and_database_hold_the_same_frames(town, workers):
    threads = torch.get_num_threads()
    town.add("b", range(3))
    town.add("a", range(70, 110))
    (town.folder / "a" / "75.png").write_text("no image")
    (town.folder / "poses.csv").write_text("frame,x,y,heading\na/73,1,2,0.5\n")
    in_memory, skipped = encode_to_memory(CHANNELS, HEAD.label_space, town.files(), workers)
    numbers = [*(n for n in range(70, 110) if n != 75), *range(3)]
    assert in_memory.frames == tuple(f"{'ab'[n < 70]}/{n}" for n in numbers)
    assert_streets(in_memory, numbers)
    assert in_memory.poses[3].tolist() == [1, 2, 0.5]
    assert np.isnan(np.delete(in_memory.poses, 3, axis=0)).all()
    summary = town.encode()
    assert counts(summary) == (42, 0, 1)
    record = town.database().known()["a/74"]
    assert (record.height, record.width, record.digest) == (24, 32, digest(street(74)))
    on_disk = town.database().load()
    assert [frame.frame for frame in skipped] == ["a/75"]
    assert skipped == summary.skipped
    assert in_memory.frames == on_disk.frames
    assert in_memory.sequences == on_disk.sequences
    assert torch.equal(in_memory.descriptors, on_disk.descriptors)
    np.testing.assert_array_equal(in_memory.poses, on_disk.poses)
    assert in_memory.empty.tolist() == on_disk.empty.tolist()
    assert torch.get_num_threads() == threads


def test_a_frame_that_cannot_be_read_or_encoded_is_skipped_and_the_others_are_encoded(town):
    """Both in the middle of a batch."""
    town.add("a", range(12))
    (town.folder / "a" / "4.png").write_text("no image")
    unknown = street(7)
    unknown[2:4, 5:8] = 99
    write_image(town.folder / "a" / "7.png", unknown)
    reported = []
    summary = town.encode(skipped=reported.append)
    assert counts(summary) == (10, 0, 2)
    assert reported == summary.skipped
    (first, unreadable), (second, undefined) = summary.skipped
    assert (first, second) == ("a/4", "a/7")
    assert f"{town.folder}/a/4.png: cannot identify" in unreadable
    assert f"{town.folder}/a/7.png: label id 99 (6 pixels) is not in label space" in undefined
    frames, right = town.database().load(), [n for n in range(12) if n not in (4, 7)]
    assert frames.frames == tuple(f"a/{n}" for n in right)
    assert_streets(frames, right)
    town.add("a", [4])
    assert counts(town.encode()) == (1, 10, 1), "a repaired file is encoded in the next run"


def test_frames_may_differ_in_size_and_format(town):
    """Ids in gray images of 8, 16 and 32 bits, and in an array."""
    sizes = [(24, 32), (30, 20), (24, 32), (130, 150), (24, 33)]
    for number in range(10):
        town.add("a", [number], *sizes[number % len(sizes)])
    labels = street(0)
    write_image(town.folder / "a" / "10.png", labels.astype(np.uint16))
    write_image(town.folder / "a" / "11.tif", labels.astype(np.int32))
    np.save(town.folder / "a" / "12.npy", labels.astype(">u4"))
    assert counts(town.encode()) == (13, 0, 0)
    frames = town.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(13)), "in natural order"
    for number, descriptor in enumerate(frames.descriptors[:10]):
        assert torch.equal(descriptor, alone(street(number, *sizes[number % len(sizes)])))
    records = town.database().known()
    for number in (10, 11, 12):
        assert torch.equal(frames.descriptors[number], alone(labels))
        assert records[f"a/{number}"].digest == records["a/0"].digest
