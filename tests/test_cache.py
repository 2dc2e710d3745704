"""The cache of label maps."""

import copy
import pickle

import numpy as np
import pytest
from drawings import SPACE
from helpers import flip_byte
from networks import (
    LABELS,
    PHOTOS,
    PLAIN,
    Street,
    Strided,
    Then,
    colour_network,
    counted,
    write_photos,
)
from torch import nn

from ssrvlad_torch.datasets.image_files import find_image_files
from ssrvlad_torch.segmentation import segmenter as segmentation
from ssrvlad_torch.segmentation.cache import SegmentedCache
from ssrvlad_torch.segmentation.preparation import SegmenterConfig
from ssrvlad_torch.segmentation.segmenter import Segmenter


def run(segmenter, folder):
    """Label maps of a folder by name."""
    return {file.name: labels for file, labels in segmenter.label_maps(find_image_files([folder]))}


@pytest.fixture
def photos(tmp_path):
    return str(write_photos(tmp_path / "photos"))


@pytest.fixture
def cache(tmp_path):
    return tmp_path / "deep" / "cache"


def entries(cache):
    return sorted(cache.rglob("*.npz"))


def test_a_label_map_is_made_once_and_found_by_the_content_of_the_image(photos, cache, tmp_path):
    network = counted(colour_network())
    first = run(Segmenter(network, SPACE, PLAIN, cache), photos)
    assert len(entries(cache)) == 5
    made = int(network.images)
    write_photos(tmp_path / "others", [3])
    (tmp_path / "others" / "3.png").rename(tmp_path / "others" / "300.png")
    segmenter = Segmenter(network, SPACE, PLAIN, cache)
    network._forward_pre_hooks.clear()
    by_name = run(segmenter, str(tmp_path / "others"))
    np.testing.assert_array_equal(by_name["300"], LABELS[3])
    run(segmenter, photos)
    assert int(network.images) == made
    assert len(first) == 5


def test_every_network_and_setting_has_its_own_key():
    other = colour_network()
    other.bias.data[3] += 1e-3

    segmenters = [
        Segmenter(colour_network(), SPACE, PLAIN),
        Segmenter(other, SPACE, PLAIN),
        Segmenter(nn.Sequential(colour_network()), SPACE, PLAIN),
        Segmenter(Strided(1), SPACE, PLAIN),
        Segmenter(Then(lambda scores: scores), SPACE, PLAIN),
        Segmenter(colour_network(), SPACE, SegmenterConfig()),
        Segmenter(colour_network(), SPACE, SegmenterConfig(colour_order="bgr")),
        Segmenter(colour_network(), SPACE, SegmenterConfig(classes=(0, 11))),
    ]
    assert len({segmenter.key() for segmenter in segmenters}) == len(segmenters)
    assert segmenters[0].key() == Segmenter(colour_network(), SPACE, PLAIN).key()


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "dangling link"])
def test_a_damaged_entry_is_made_anew(photos, cache, damage):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, photos)
    entry = entries(cache)[2]
    whole = entry.read_bytes()
    if damage == "flip":
        flip_byte(entry, len(whole) // 2)
    elif damage == "dangling link":
        entry.unlink()
        entry.symlink_to("nowhere")
    else:
        entry.write_bytes({"cut": whole[:-20], "empty": b""}[damage])
    for name, labels in run(segmenter, photos).items():
        np.testing.assert_array_equal(labels, LABELS[int(name)])
    assert entry.read_bytes() == whole


def test_the_cache_is_bounded_and_keeps_what_was_used_last(photos, cache, tmp_path, monkeypatch):
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, photos)
    size = max(entry.stat().st_size for entry in entries(cache))
    first = {entry.name for entry in entries(cache)}
    recent = write_photos(tmp_path / "recent", [2])
    run(segmenter, str(recent))
    used = max(entries(cache), key=lambda entry: entry.stat().st_mtime_ns).name
    monkeypatch.setattr("ssrvlad_torch.segmentation.cache.LARGEST", 4 * size)
    run(segmenter, str(write_photos(tmp_path / "more", [20])))
    left = {entry.name for entry in entries(cache)}
    assert sum(entry.stat().st_size for entry in entries(cache)) <= 4 * size
    assert used in left
    assert first - left
    assert left - first, "the new one is there"


def test_pictures_that_come_one_by_one_read_the_folder_of_the_cache_once(
    photos, cache, monkeypatch
):
    scans, bounded = [], SegmentedCache._bounded
    monkeypatch.setattr(SegmentedCache, "_bounded", lambda of: scans.append(of) or bounded(of))
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    for file in find_image_files([photos]):
        assert len([*segmenter.segmented([file])]) == 1
    assert (len(entries(cache)), len(scans)) == (5, 1)


def test_what_other_processes_store_counts_for_the_bound(photos, cache, tmp_path, monkeypatch):
    monkeypatch.setattr("ssrvlad_torch.segmentation.cache.UNSEEN", 0)
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    run(segmenter, str(write_photos(tmp_path / "first", [20])))
    run(Segmenter(colour_network(), SPACE, PLAIN, cache), photos)
    largest = sum(entry.stat().st_size for entry in entries(cache))
    monkeypatch.setattr("ssrvlad_torch.segmentation.cache.LARGEST", largest)
    run(segmenter, str(write_photos(tmp_path / "last", [21])))
    assert sum(entry.stat().st_size for entry in entries(cache)) <= largest


def test_label_maps_made_before_ctrl_c_are_kept(photos, cache, monkeypatch):
    monkeypatch.setattr(segmentation, "PIXELS_AT_ONCE", 1)
    segmenter = Segmenter(colour_network(), SPACE, PLAIN, cache)
    segmenter.key()
    left = iter([None, None, None])

    def interrupt(module, arguments):
        if next(left, "end") == "end":
            raise KeyboardInterrupt

    monkeypatch.setattr(segmenter, "key", lambda: "key")
    segmenter.network.register_forward_pre_hook(interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(segmenter, photos)
    assert len(entries(cache)) == 3


# ---- the identity of a network: a digest of its state


def test_equal_networks_have_one_identity_in_every_process():
    segmenter = Segmenter(Street(), SPACE, PLAIN)
    key = segmenter.key()
    again = pickle.loads(pickle.dumps(segmenter))
    again([PHOTOS[0].repeat(4, 0).repeat(4, 1)])
    assert again.key() == key == Segmenter(copy.deepcopy(Street()), SPACE, PLAIN).key()
