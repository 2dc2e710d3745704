"""Features as a method: the signs of `Segmenter.segment`, and their steps."""

import json

import numpy as np
import pytest
import torch
from drawings import SPACE
from methods import frames, picture
from networks import PLAIN, Street, write_street
from segmenting import write_photos

from ssrvlad_torch.baselines import make
from ssrvlad_torch.baselines.channel_methods import EncoderFeatures
from ssrvlad_torch.baselines.run import run
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.recognition.recognise import Steps, references_of
from ssrvlad_torch.segmentation.segmenter import Segmenter


@pytest.fixture
def segmenter():
    return Segmenter(Street(), SPACE, PLAIN)


def drive(count: int, sequence: str = "a") -> list[View]:
    """Pictures of one size, each of other blocks."""
    return frames((picture(n, 128, 192, grain=16) for n in range(count)), sequence)


def test_scores_are_the_cosines_of_the_signs_of_the_segmenter(segmenter):
    method, pictures = EncoderFeatures(segmenter), [frame.picture for frame in drive(6)]
    signs = method.encode_reference(drive(6))
    expected = [result.features for result in segmenter.segment(pictures, features=True)]
    np.testing.assert_array_equal(signs.numpy(), np.stack(expected))
    assert torch.equal(method.encode_query(drive(6)), signs)
    scores = method.scores(signs[:2], signs)
    town = references_of({"features": signs}, [""] * len(signs))
    expected, _ = town.compare({"features": signs[:2].numpy()}, sweep=True)
    np.testing.assert_allclose(scores, expected)
    assert scores.argmax(1).tolist() == [0, 1]


def test_the_steps_standardise_signs(segmenter):
    retrieval = run(EncoderFeatures(segmenter), drive(32), drive(32, "b"), steps=Steps(follow=None))
    assert retrieval.costs["bytes_a_reference"] == 4096
    assert retrieval.stepped.used["standardise"] == {"a": True}
    assert retrieval.stepped.matches.indices[:, 0].tolist() == list(range(32))


def test_compare_measures_it(ssrvlad, tmp_path):
    write_street(tmp_path / "net.onnx")
    network = tmp_path / "net.yaml"
    network.write_text("network: net.onnx\nlabels_as: camvid-11\n")
    for drive in ("query", "reference"):
        write_photos(tmp_path / "town" / drive / "images", size=(48, 64))
    options = ("--set", f"features.network={network}", "--tolerance-frames", 0, "--json")
    code, out, err = ssrvlad("compare", tmp_path / "town", "--method", "features,hog", *options)
    assert code == 0, err
    row = json.loads(out)["rows"][0]
    assert (row["method"], row["recall_at"]["1"]) == ("features", 1.0)
    with pytest.raises(FileNotFoundError, match="no network: features needs a segmentation net"):
        make("features")
