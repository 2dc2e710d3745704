"""Vocabularies: own files, the authors' pickles, and training from a folder of images."""

import os
import pickle
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from ssrvlad_torch.baselines.region_features import RegionFeatures
from ssrvlad_torch.baselines.vocabulary import read_vocabulary, train_vocabulary

WORDS = np.random.default_rng(0).random((4, 384))


class Ran:
    """Runs a command when a careless reader unpickles it."""

    def __reduce__(self):
        return (os.system, ("exit 1",))


@pytest.fixture
def scikit_learn(monkeypatch):
    """A stand-in for scikit-learn, there while the pickle is written and gone when it is read."""

    class KMeans:
        def __init__(self, centres):
            self.n_clusters, self.cluster_centers_ = len(centres), centres
            self.inertia_, self.n_iter_ = np.float64(3.5), np.int64(7)
            self.random_state = np.random.RandomState(0)
            self.labels_ = np.zeros(9, np.int32)

    KMeans.__module__, KMeans.__qualname__ = "sklearn.cluster.k_means_", "KMeans"
    for name in ("sklearn", "sklearn.cluster", "sklearn.cluster.k_means_"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["sklearn.cluster.k_means_"].KMeans = KMeans  # type: ignore[attr-defined]
    yield KMeans
    for name in ("sklearn.cluster.k_means_", "sklearn.cluster", "sklearn"):
        assert sys.modules.pop(name, None) is not None


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("kind", [int, str])
def test_the_authors_pickle(protocol, kind, scikit_learn, tmp_path, monkeypatch):
    """Regions, then words, then layer, with numbers or strings as keys."""
    path = tmp_path / "Vocabulary_400.pkl"
    by_words = {kind(n): {"conv3": scikit_learn(WORDS[:n])} for n in (2, 4)}
    path.write_bytes(pickle.dumps({kind(400): by_words}, protocol))
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "sklearn.cluster.k_means_", None)
        for words in (2, 4):
            found = read_vocabulary(path, words)
            np.testing.assert_array_equal(found.numpy(), WORDS[:words].astype(np.float32))
        old = path.read_bytes().replace(b"cnumpy._core.multi", b"cnumpy.core.multi")
        assert protocol > 3 or (b"numpy._core.multi" not in old and old != path.read_bytes())
        path.write_bytes(old)
        assert read_vocabulary(path, 4).shape == (4, 384)


def test_an_array(tmp_path):
    np.save(tmp_path / "words.npy", WORDS)
    found = read_vocabulary(tmp_path / "words.npy", 4)
    assert found.dtype == torch.float32
    np.testing.assert_array_equal(found.numpy(), WORDS.astype(np.float32))


def test_objects_in_an_array_are_refused(tmp_path):
    np.save(tmp_path / "words.npy", np.array([Ran()], object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"words\.npy is not a whole vocabulary"):
        read_vocabulary(tmp_path / "words.npy", 4)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Ran(), r"words\.pkl is not a whole vocabulary: it refers to"),
        ({400: Ran()}, "it refers to"),
        ({400: {4: {"conv3": Path}}}, "it refers to"),
        ({200: {}}, r"expected an entry 400, got \[200\]"),
        ({400: {2: {}}}, r"expected an entry 4, got \[2\]"),
        ({400: {4: {"conv4": 1}}}, r"expected an entry conv3, got \['conv4'\]"),
        ([1], "expected an entry 400, got list"),
        ({400: {4: {"conv3": 1}}}, "cluster_centers_"),
    ],
)
def test_another_pickle_is_named(content, message, tmp_path):
    (tmp_path / "words.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_vocabulary(tmp_path / "words.pkl", 4)


@pytest.mark.parametrize("array", [WORDS[:3], WORDS[:, :9], WORDS[0], WORDS * np.nan])
def test_a_wrong_shape_or_no_numbers(array, tmp_path):
    np.save(tmp_path / "words.npy", array)
    with pytest.raises(ValueError, match=r"must hold a vocabulary \(4, 384\) of finite numbers"):
        read_vocabulary(tmp_path / "words.npy", 4)


@pytest.mark.parametrize("keep", [0, 3, 50, 2000])
@pytest.mark.parametrize("name", ["words.npy", "words.pkl"])
def test_a_cut_file(keep, name, tmp_path):
    np.save(tmp_path / "words.npy", WORDS)
    (tmp_path / "words.pkl").write_bytes(pickle.dumps({400: {4: {"conv3": WORDS}}}))
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match=f"{name} is not a whole vocabulary"):
        read_vocabulary(path, 4)


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    for i, name in enumerate(("b.png", "a.jpg", "inner/c.PNG")):
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        form = "JPEG" if name.endswith("jpg") else "PNG"
        Image.fromarray(rng.integers(0, 256, (30 + i, 40, 3), np.uint8)).save(path, form)
    (tmp_path / "images" / "notes.txt").write_text("none of these")
    return tmp_path / "images"


def test_training_clusters_the_regions_of_all_images(folder, tmp_path):
    features = RegionFeatures(random_weights=True, regions=8)
    path = tmp_path / "words.npy"
    words = train_vocabulary(folder, path, features, words=6, seed=3)
    pictures = [np.asarray(Image.open(folder / name)) for name in ("a.jpg", "b.png", "inner/c.PNG")]
    regions = torch.cat(list(features(pictures)))
    nearest = torch.cdist(regions, words).argmin(1)
    means = torch.stack([regions[nearest == word].mean(dim=0) for word in range(6)])
    torch.testing.assert_close(words, means, rtol=1e-3, atol=1e-4)
    assert torch.equal(read_vocabulary(path, 6), words)


def test_training_needs_images_that_can_be_read(folder, tmp_path, monkeypatch):
    features = RegionFeatures(random_weights=True, regions=8)
    with pytest.raises(ValueError, match="no images under"):
        train_vocabulary(tmp_path / "empty", tmp_path / "words.npy", features)
    with pytest.raises(ValueError, match="256 words need as many distinct regions"):
        train_vocabulary(folder, tmp_path / "words.npy", features)
    (folder / "broken.png").write_text("no image")
    with pytest.raises(ValueError, match=r"broken\.png: is no image file"):
        train_vocabulary(folder, tmp_path / "words.npy", features)
    monkeypatch.setenv("SSRVLAD_FILE_LIMIT", "5")
    with pytest.raises(ValueError, match=r"^[^:]*a\.jpg has \d+ bytes; expected at most 5"):
        train_vocabulary(folder, tmp_path / "words.npy", features)
    assert not (tmp_path / "words.npy").exists()
