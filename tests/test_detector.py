"""The detector with a network of its own; its decisions are asked by test_loop_closure.py."""

import copy
import pickle

import numpy as np
import pytest
import torch
from helpers import refuses, street
from networks import photo

from ssrvlad_torch import LoopDetector, Map, Segmenter, native
from ssrvlad_torch.loops.config import LoopConfig

PLACES = (*range(12), *range(4, 10))
CONFIG = LoopConfig(exclude=5)


@pytest.mark.parametrize("channels", [None, ["hog"], ["ssr-vlad"]])
def test_a_picture_is_labelled_and_described_as_if_all_were_given(drives, channels, monkeypatch):
    network = drives / "net.yaml"
    ours = LoopDetector.from_pretrained(network, config=CONFIG, channels=channels)
    names = [channel.column.name for channel in ours.channels]
    assert names == [*dict.fromkeys(["ssr-vlad", *(channels or ["features", "hog"])])]
    segmenter = Segmenter.load(network)
    with_it = LoopDetector.from_pretrained(segmenter, config=CONFIG, channels=channels)
    assert with_it.segmenter is segmenter
    assert [c.column for c in with_it.channels] == [c.column for c in ours.channels]
    theirs = LoopDetector(CONFIG, ours.head, ours.channels[1:])
    for number, seed in enumerate(PLACES):
        picture = photo(street(seed, 96, 128))
        [labelled] = segmenter.segment([picture], "features" in names)
        material = {"picture": picture} if "hog" in names else {}
        material |= {"features": labelled.features} if "features" in names else {}
        expected = theirs.update(labelled.labels, f"drive/{number:03d}", float(number), **material)
        assert ours.update(picture, f"drive/{number:03d}", float(number)) == expected
    assert ours.weights.keys() == (set(names) if len(names) > 1 else set())
    assert not ours.scans
    monkeypatch.setattr("ssrvlad_torch.loops.detector.SCAN_ABOVE", len(PLACES) - CONFIG.exclude - 1)
    assert ours.scans == ("features" in names)


def test_what_is_no_picture_is_refused_and_leaves_no_trace(drives):
    detector = LoopDetector.from_pretrained(drives / "net.yaml")
    with pytest.raises(ValueError, match=r"expected a list of \(H, W, 3\) uint8 images"):
        detector.update(np.zeros((96, 128, 3)), "drive/000")
    assert len(detector) == 0
    with pytest.raises(ValueError, match="expected a channel"):
        LoopDetector.from_pretrained(drives / "net.yaml", channels=["nothing"])
    with pytest.raises(ValueError, match="its name, its file or a Segmenter, got Identity"):
        LoopDetector.from_pretrained(torch.nn.Identity())


def test_a_path_is_no_database():
    for call in (LoopDetector().save, LoopDetector.load):
        refuses(r"such as Database\.open\(path\), got 'mem\.ssrdb'", call, "mem.ssrdb")


def test_without_a_network_a_picture_is_no_label_map():
    with pytest.raises(ValueError, match="class scores must be floating point"):
        LoopDetector().update(photo(street(0, 96, 128)), "drive/000")


def test_without_the_core_there_is_no_detector(monkeypatch):
    monkeypatch.setattr(native, "core", lambda: native.Core(None, "it was not built"))
    with pytest.raises(RuntimeError, match=r"^it was not built$"):
        LoopDetector(CONFIG)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
@pytest.mark.parametrize("make", [LoopDetector, lambda: Map("town.ssrdb")])
def test_copies_are_refused_in_words(make, duplicate):
    with pytest.raises(TypeError, match=r"be copied or pickled: (save and|open town\.ssrdb)"):
        duplicate(make())
