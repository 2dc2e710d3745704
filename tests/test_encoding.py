"""One frame after another: reading, describing and skipping, with all that encoding is made of."""

from pathlib import Path

import numpy as np
import torch
from helpers import street
from maps import HEAD, alone, assert_streets, counts
from PIL import Image

from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.label_files import digest
from ssrvlad_torch.encoding import describer
from ssrvlad_torch.encoding.describer import Item


def test_a_frame_that_cannot_be_read_or_encoded_is_skipped_and_the_others_are_encoded(town):
    """Both in the middle of a batch."""
    town.add("a", range(12))
    (town.folder / "a" / "4.png").write_text("no image")
    unknown = street(7)
    unknown[2:4, 5:8] = 99
    town.write("a/7", unknown)
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
    town.write("a/10", labels.astype(np.uint16))
    Image.fromarray(labels.astype(np.int32)).save(town.folder / "a" / "11.tif")
    np.save(town.folder / "a" / "12.npy", labels.astype(">u4"))
    assert counts(town.encode()) == (13, 0, 0)
    frames = town.database().load()
    assert frames.frames == tuple(f"a/{n}" for n in range(13)), "in natural order"
    for number, descriptor in enumerate(frames.descriptors[:10]):
        assert torch.equal(descriptor, alone(street(number, *sizes[number % len(sizes)])))
    known = town.database().known()
    for number in (10, 11, 12):
        assert torch.equal(frames.descriptors[number], alone(labels))
        assert known[f"a/{number}"].digest == known["a/0"].digest


def test_label_maps_already_read_start_no_threads(monkeypatch):
    monkeypatch.setattr(FrameFile, "readers", 4)
    items = [Item(FrameFile("a", "0", Path("0.png")), "", street(0), None, digest(street(0)))]
    monkeypatch.setattr(describer, "in_order", None)
    assert describer.read(HEAD.label_space, items) == items
