"""`ssrvlad vocabulary`."""

import json

import pytest
import torch
from drives import write_photos

from ssrvlad_torch.baselines.region_features import AlexNetPlaces365
from ssrvlad_torch.baselines.vocabulary import read_vocabulary
from ssrvlad_torch.baselines.weights import random_network


@pytest.fixture
def weights(tmp_path):
    path = tmp_path / "weights" / "alexnet_places365.caffemodel.pt"
    path.parent.mkdir()
    torch.save(random_network(AlexNetPlaces365).state_dict(), path)
    return path


def test_a_vocabulary_is_trained_and_used(ssrvlad, weights, tmp_path):
    photos, words = write_photos(tmp_path / "monday", range(3)), tmp_path / "words.npy"
    code, out, err = ssrvlad(
        "vocabulary", photos, "-o", words, "--weights", weights.parent, "--words", 6,
        "--regions", 20, "--seed", 3,
    )  # fmt: skip
    assert (code, out, err) == (0, f"{words}: 6 words\n", [])
    assert read_vocabulary(words, 6).shape == (6, 384)

    values = {"words": 6, "regions": 20, "weights": weights, "vocabulary": words}
    settings = [f"--set=region-vlad.{name}={value}" for name, value in values.items()]
    today = write_photos(tmp_path / "today", range(3))
    drives = ("--references", photos, "--queries", today, "--tolerance-frames", 0)
    code, out, err = ssrvlad("compare", "--method", "region-vlad", *settings, *drives, "--json")
    assert (code, err) == (0, [])
    assert json.loads(out)["rows"][0]["recall_at"]["1"] == 1


def test_a_vocabulary_needs_weights_and_images(refusal, weights, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    photos = write_photos(tmp_path / "monday", range(1))
    (tmp_path / "empty").mkdir()
    cases = {
        "no weights at": (photos,),
        "no images under": (tmp_path / "empty", "--weights", weights),
        "99999 words need": (photos, "--weights", weights, "--words", 99999),
    }
    for message, arguments in cases.items():
        assert message in refusal("vocabulary", *arguments, "-o", tmp_path / "words.npy")
    assert not (tmp_path / "words.npy").exists()
