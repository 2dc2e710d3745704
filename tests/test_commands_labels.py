"""`ssrvlad labels`: classes, features and activations."""

import json

from drawings import SPACE
from networks import write_graph, write_street


def test_labels_lists_classes_and_features(network, ssrvlad, refusal, tmp_path):
    code, out, _ = ssrvlad("labels", network)
    assert code == 0
    assert "8 of 12 classes have a category" in out
    assert "left out: car, pedestrian, bicyclist, void" in out
    assert "features: none: " in out and "no activation at a stride from 4 to 32" in out
    of_space = json.loads(ssrvlad("labels", SPACE, "--json")[1])
    assert of_space["classes"][3] == {"id": 3, "name": "road", "category": "ground"}
    assert of_space["features"] is None
    write_street(tmp_path / "net.onnx")
    settings = tmp_path / "net.yaml"
    for named, names in (("", ["relu_2", "relu_3"]), ("features: [relu_1]", ["relu_1"])):
        settings.write_text(f"network: net.onnx\nlabels_as: {SPACE}\n{named}")
        assert f"features: {names[0]} (1, " in ssrvlad("labels", settings)[1]
        assert json.loads(ssrvlad("labels", settings, "--json")[1])["features"] == names
    settings.write_text("mean: [0, 0, 0]\nclasses: 0:19\n")
    for given, message in (
        (settings, "net.yaml names no network; expected network: NAME"),
        ("camvid-1", "unknown label space 'camvid-1': did you mean camvid-11"),
        ("net.onxx", "no network 'net.onxx'"),
    ):
        assert message in refusal("labels", given)
    assert ssrvlad("labels", "mapillary-vistas-1.2")[::2] == (0, [])


def test_labels_lists_all_activations(ssrvlad, refusal, tmp_path):
    """Also of a network that has no features by the rule, and of one without class names."""
    write_street(tmp_path / "street.onnx")
    command = ("labels", tmp_path / "street.onnx", "--labels-as", SPACE)
    code, out, err = ssrvlad(*command, "--all")
    assert (code, err) == (0, [])
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines()]
    assert [row for row in rows if "features" in row] == [
        ["relu_2", "32", "28", "56", "8", "features"],
        ["relu_3", "24", "14", "28", "16", "features"],
    ]
    *_, line = out.splitlines()
    assert line == "features: relu_2 (1, 32, 28, 56), stride 8, relu_3 (1, 24, 14, 28), stride 16"
    listed = json.loads(ssrvlad(*command, "--all", "--json")[1])["activations"]
    by_name = {row["name"]: row for row in listed}
    assert by_name["relu_2"]["chosen"] and by_name["relu_2"]["shape"] == [1, 32, 28, 56]
    assert (by_name["relu_3"]["stride"], by_name["relu_3"]["raised"]) == (16, False)
    assert by_name["conv2d_9"]["raised"], "of the decoder"
    assert sum(row["chosen"] for row in listed) == 2
    assert "activations" not in json.loads(ssrvlad(*command, "--json")[1])
    write_graph(tmp_path / "net.onnx")
    out = ssrvlad("labels", tmp_path / "net.onnx", "--labels-as", SPACE, "--all")[1]
    assert "classes" in out and "features: none: " in out
    assert "--labels-as and --all are for networks" in refusal("labels", SPACE, "--all")
