"""VLAD over regions against loops, and Region-VLAD as a method."""

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refused
from methods import frames
from plain_layers import Array, unit
from test_region_features import images, write

from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.region_features import AlexNetPlaces365, RegionFeatures
from ssrvlad_torch.baselines.region_vlad import RegionVLAD, vlad
from ssrvlad_torch.channels.channel import View


def described(descriptors: Array, words: Array) -> Array:
    """Residuals to the nearest word, summed word by word, signed root, length 1."""
    sums = np.zeros_like(words)
    for x in descriptors:
        nearest = min(range(len(words)), key=lambda k: ((x - words[k]) ** 2).sum())
        sums[nearest] += x - words[nearest]
    flat = sums.ravel()
    return unit(np.array([np.sign(v) * abs(v) ** 0.5 for v in flat]))


@pytest.mark.parametrize("seed", range(4))
def test_vlad_is_what_it_says(seed):
    rng = np.random.default_rng(seed)
    descriptors, words = rng.random((30, 5)), rng.random((6, 5))
    got = vlad(torch.from_numpy(descriptors), torch.from_numpy(words))
    np.testing.assert_allclose(got.numpy(), described(descriptors, words), rtol=1e-9)
    words = torch.from_numpy(words)
    assert not vlad(words[:0], words).any() and not vlad(words, words).any()


@pytest.fixture
def folder(tmp_path):
    torch.manual_seed(1)
    write(tmp_path / "alexnet_places365.caffemodel", AlexNetPlaces365(), "caffe")
    words = 300 * np.random.default_rng(0).random((256, 384))
    np.save(tmp_path / "region_vlad_vocabulary.npy", words)
    return tmp_path


def test_it_is_vlad_of_the_regions(folder):
    method = RegionVLAD(folder, folder)
    assert (method.name, method.needs) == ("region-vlad", {"images", "weights"})
    found = method.encode_query(frames(images()))
    words = np.load(folder / "region_vlad_vocabulary.npy")
    for row, regions in zip(found, RegionFeatures(folder)(images()), strict=True):
        assert regions.shape == (400, 384)
        expected = described(regions.double().numpy(), words)
        np.testing.assert_allclose(row.numpy(), expected, atol=1e-5)
    assert torch.equal(method.encode_reference(frames(images())), found)
    torch.testing.assert_close(method.scores(found, found).diagonal(), torch.ones(2))
    assert method.encode_query([]).shape == (0, 256 * 384)


def test_a_black_picture_matches_nothing(folder):
    path = folder / "alexnet_places365.caffemodel"
    network = AlexNetPlaces365()
    for parameter in network.parameters():
        torch.nn.init.zeros_(parameter)
    write(path, network, "caffe")
    method = RegionVLAD(folder, folder)
    black = method.encode_query(frames(images(1)))
    assert not black.any()
    assert method.scores(black, black).item() == -torch.inf


def test_missing_files_are_one_line_each(folder, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: folder / "nobody")
    for settings, part in (
        ({}, r"alexnet_places365\.caffemodel .*Places365"),
        ({"weights": folder}, "region_vlad_vocabulary.npy or Vocabulary_400.pkl"),
        ({"weights": folder, "regions": 200}, "Vocabulary_100_200_300.pkl"),
    ):
        with refused(part, by=FileNotFoundError):
            make("region-vlad", **settings)


def test_random_weights_say_what_they_are():
    method = RegionVLAD(random_weights=True)
    assert method.name == "region-vlad (random weights)"
    assert method.encode_query(frames(images(1))).shape == (1, 256 * 384)
    with pytest.raises(ValueError, match=r"region-vlad .* needs pictures, but frame a/b"):
        method.encode_query([View("a/b")])
