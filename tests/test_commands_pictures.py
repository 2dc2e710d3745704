"""The command line on images: a network by name, its own class names, what maps where."""

from __future__ import annotations

import json

import numpy as np
import onnx
import pytest
from drawings import SPACE
from helpers import street
from networks import photo, write_graph
from PIL import Image

from ssrvlad_torch.taxonomy import label_space


@pytest.fixture
def network(tmp_path):
    """A graph that says what its classes are, and a file of its settings."""
    path = write_graph(tmp_path / "net.onnx")
    names = {label.id: label.name for label in label_space(SPACE).classes}
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"id2label": json.dumps(names)})
    onnx.save(model, path)
    settings = tmp_path / "net.yaml"
    settings.write_text("network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n")
    (tmp_path / "photos").mkdir()
    for seed in range(3):
        Image.fromarray(photo(street(seed, 60, 80))).save(tmp_path / "photos" / f"{seed}.png")
    return settings


def test_images_need_no_label_space_where_the_network_says_its_own(network, ssrvlad, tmp_path):
    photos, town = tmp_path / "photos", tmp_path / "town"
    given = ("--segmenter", network, "--segmenter-cache", tmp_path / "cache")
    code, out, err = ssrvlad("encode", photos, "-o", town, *given)
    assert (code, err) == (0, [])
    code, out, err = ssrvlad("query", town, photos, *given, "--top", 1, "--json")
    assert (code, err) == (0, [])
    assert [json.loads(line)["candidates"][0]["frame"] for line in out.splitlines()] == [
        f"photos/{seed}" for seed in range(3)
    ]


def test_labels_lists_what_is_left_out(network, ssrvlad):
    code, out, _ = ssrvlad("labels", network)
    assert code == 0
    assert "8 of 12 classes have a category" in out
    assert "left out: car, pedestrian, bicyclist, void" in out
    of_space = json.loads(ssrvlad("labels", SPACE, "--json")[1])
    assert of_space["classes"][3] == {"id": 3, "name": "road", "category": "ground"}


def test_channels_are_named(network, ssrvlad, tmp_path):
    code, _, err = ssrvlad(
        "encode", tmp_path / "photos", "-o", tmp_path / "town", "--segmenter", network,
        "--labels-as", SPACE, "--classes", "12",
    )  # fmt: skip
    assert (code, len(err)) == (2, 1)
    assert "classes must be FIRST:LAST" in err[0]


def test_show_takes_an_image(network, ssrvlad, tmp_path):
    frame, picture = tmp_path / "photos" / "1.png", tmp_path / "out.png"
    assert ssrvlad("show", frame, "-o", picture, "--segmenter", network)[0] == 0
    assert np.asarray(Image.open(picture)).size
    assert "--labels-as" in ssrvlad("show", frame, "-o", picture)[2][0]
