"""The command line on images: a network by name, its own class names, what maps where."""

import io
import json

import numpy as np
import onnx
import pytest
from cases import REAL, needs_real
from drawings import SPACE
from helpers import street
from networks import photo, write_graph, write_street
from PIL import Image
from segmenting import write_image, write_photos, write_settings

from ssrvlad_torch import Database
from ssrvlad_torch.encoding import source as sources
from ssrvlad_torch.taxonomy import label_space

TRUTH = "same_place_odd_even.json"


@pytest.fixture
def network(tmp_path):
    """A graph that says what its classes are, and a file of its settings."""
    settings = write_settings(tmp_path)
    path = tmp_path / "net.onnx"
    names = {label.id: label.name for label in label_space(SPACE).classes}
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"id2label": json.dumps(names)})
    onnx.save(model, path)
    write_photos(tmp_path / "photos", range(3), (60, 80))
    return settings


@pytest.fixture
def town(network, ssrvlad, tmp_path):
    """A database of the photos, all but one with a pose."""
    poses = ["frame,x,y,heading", *(f"photos/{seed},{seed},0,0.5" for seed in range(2))]
    (tmp_path / "poses.csv").write_text("\n".join(poses))
    town = tmp_path / "town"
    cache = ("--segmenter-cache", tmp_path / "cache")
    given = ("--segmenter", network, "--channel", "ssr-vlad", *cache)
    ssrvlad("encode", tmp_path / "photos", "-o", town, *given)
    return town


def test_locate_takes_the_network_of_the_database(town, network, ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    photos = [tmp_path / "photos" / f"{seed}.png" for seed in (1, 2)]
    code, out, _ = ssrvlad("locate", *photos, "--in", town)
    first, second = out.splitlines()
    assert code == 0
    assert first.startswith("photos/1: photos/1, cosine ")
    assert first.endswith("x 1.0 m, y 0.0 m, heading 29 degrees")
    assert second.endswith("pose unknown")
    found = json.loads(ssrvlad("locate", photos[0], "--in", town, "--json")[1])
    assert (found["picture"], found["place"], found["x"]) == ("photos/1", "photos/1", 1)
    assert found["score_is"] == "cosine" and found["score"] <= 1
    unsure = ssrvlad("locate", photos[0], "--in", town, "--min-confidence", 1)[1]
    assert unsure.startswith("photos/1: no place (confidence 0.")
    network.write_text("network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 2]\n")
    sources._network.cache_clear()
    code, _, (line,) = ssrvlad("locate", photos[0], "--in", town)
    assert code == 2
    assert "gives other label maps" in line


def test_locate_takes_no_network_from_label_maps_or_of_code(ssrvlad, database, tmp_path):
    code, _, (line,) = ssrvlad("locate", tmp_path, "--in", database)
    assert code == 2
    assert "was not made from pictures; name a --segmenter" in line
    Database.open(database).add_origin(None, "key", "mynets:mine")
    (line,) = ssrvlad("locate", tmp_path, "--in", database)[2]
    assert line.endswith("was made by code: say --segmenter mynets:mine")


def camera(folder, seeds):
    """Photographs with noise, which are no label maps in colours."""
    noise = np.random.default_rng(0)
    for seed in seeds:
        pixels = photo(street(seed, 60, 80)).astype(int) + noise.integers(-2, 3, (60, 80, 3))
        write_image(folder / f"{seed}.png", pixels.clip(0, 255).astype(np.uint8))
    return folder


def test_every_command_takes_the_network_of_the_database(
    network, ssrvlad, maps, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monday, tuesday = (camera(tmp_path / name, range(4)) for name in ("first", "second"))
    town, named = tmp_path / "drives", ("--segmenter", network)
    assert ssrvlad("encode", monday, "-o", town, *named)[0] == 0

    def clear():
        after = Database.open(town)
        after.remove([frame for frame in after.load().frames if not frame.startswith("first/")])

    for command in (
        ("query", town, tuesday, "--json"),
        ("evaluate", town, tuesday, "--tolerance-frames", 0, "--json"),
        ("loops", tuesday, "--memory", town, "--json"),
        ("encode", tuesday, "-o", town, "--json"),
    ):
        expected = ssrvlad(*command, *named)[1]
        clear()
        code, out, err = ssrvlad(*command)
        assert (code, without_version(out)) == (0, without_version(expected)), (command, err)
        clear()
        assert err[0] == f"ssrvlad: {network}, the network of {town}, labels the pictures"
    code, _, err = ssrvlad("query", town, maps, "--channel", "ssr-vlad")
    assert (code, len(err)) == (0, 1), "label maps need no network"


def without_version(out):
    lines = [json.loads(line) for line in out.splitlines()]
    return [{key: line[key] for key in line.keys() - {"version"}} for line in lines]


def test_what_is_assumed_of_a_network_is_told(network, ssrvlad, tmp_path):
    given = ("--labels-as", SPACE, "--segmenter-cache", tmp_path / "cache", "--segmenter")
    accepting = {each: tmp_path / f"{each}.yaml" for each in ("true", "false", "3")}
    for each, path in accepting.items():
        path.write_text(f"network: net.onnx\nsize: 60\naccept_defaults: {each}\n")
    for name, told in (
        (network, False), (tmp_path / "net.onnx", True), (accepting["true"], False),
        (accepting["false"], True),
    ):  # fmt: skip
        town = tmp_path / f"town of {name.name}"
        _, _, err = ssrvlad("encode", tmp_path / "photos", "-o", town, *given, name)
        assumed = [line for line in err if "assumed: rgb, 0 to 1, mean (0.485, 0.456" in line]
        assert len(assumed) == told
        assert all(
            "(accept_defaults: true in a YAML file accepts that)" in line for line in assumed
        )
    (line,) = ssrvlad("encode", tmp_path / "photos", "-o", tmp_path / "x", *given, accepting["3"])[
        2
    ]
    assert "3.yaml: accept_defaults must be true or false, got 3" in line


def test_labels_lists_classes_and_features(network, ssrvlad, tmp_path):
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
    for named, name in (("", "relu_2"), ("features: [relu_1]", "relu_1")):
        settings.write_text(f"network: net.onnx\nlabels_as: {SPACE}\n{named}")
        assert f"features: {name} (1, " in ssrvlad("labels", settings)[1]
        assert json.loads(ssrvlad("labels", settings, "--json")[1])["features"] == [name]
    for given, message in (
        ("camvid-1", "unknown label space 'camvid-1': did you mean camvid-11"),
        ("net.onxx", "no network 'net.onxx'"),
    ):
        code, _, (line,) = ssrvlad("labels", given)
        assert code == 2 and message in line
    assert ssrvlad("labels", "mapillary-vistas-1.2")[::2] == (0, [])


def test_labels_lists_all_activations(ssrvlad, tmp_path):
    """Also of a network that has no features by the rule, and of one without class names."""
    write_street(tmp_path / "street.onnx")
    command = ("labels", tmp_path / "street.onnx", "--labels-as", SPACE)
    code, out, err = ssrvlad(*command, "--all")
    assert (code, err) == (0, [])
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines()]
    assert [row for row in rows if "features" in row] == [
        ["relu_2", "32", "28", "56", "8", "features"]
    ]
    assert out.splitlines()[-1] == "features: relu_2 (1, 32, 28, 56), stride 8"
    listed = json.loads(ssrvlad(*command, "--all", "--json")[1])["activations"]
    by_name = {each["name"]: each for each in listed}
    assert by_name["relu_2"]["chosen"] and by_name["relu_2"]["shape"] == [1, 32, 28, 56]
    assert (by_name["relu_3"]["stride"], by_name["relu_3"]["raised"]) == (16, False)
    assert by_name["conv2d_9"]["raised"], "of the decoder"
    assert sum(each["chosen"] for each in listed) == 1
    assert "activations" not in json.loads(ssrvlad(*command, "--json")[1])
    write_graph(tmp_path / "net.onnx")
    out = ssrvlad("labels", tmp_path / "net.onnx", "--labels-as", SPACE, "--all")[1]
    assert "classes" in out and "features: none: " in out
    assert "--labels-as and --all are for networks" in ssrvlad("labels", SPACE, "--all")[2][0]


def test_show_takes_an_image(network, ssrvlad, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    frame, picture = tmp_path / "photos" / "1.png", tmp_path / "out.png"
    assert ssrvlad("show", frame, "-o", picture, "--segmenter", network)[0] == 0
    shown = Image.open(picture)
    labels = frame.with_name("labels.png")
    Image.fromarray(street(1, 60, 80)).save(labels)
    assert ssrvlad("show", labels, "-o", tmp_path / "map.png", "--labels-as", SPACE)[0] == 0
    assert shown.width == 1.5 * Image.open(tmp_path / "map.png").width, (
        "the photograph is beside it"
    )
    sky = np.array([128, 128, 128])
    assert (np.abs(np.asarray(shown)[..., :3] - sky) < 2).all(-1).any()
    assert len([*(tmp_path / "cache").rglob("*.png")]) == 1
    assert "--labels-as" in ssrvlad("show", frame, "-o", picture)[2][0]


@pytest.mark.slow
@needs_real
def test_a_real_network_finds_what_its_stored_predictions_find(ssrvlad, tmp_path):
    """ESPNetv2 on every other picture of CamVid against the label maps of those between."""
    camvid, town = REAL / "camvid", tmp_path / "town"
    known = (camvid, "--layout", "folders", "--every", 2)
    assert ssrvlad("encode", *known, "--labels-as", SPACE, "-o", town)[0] == 0
    asked = ("--start", 1, "--labels-as", "cityscapes-trainids", "--json", "--follow", "no")
    truth = ("--no-standardise", "--no-sweep", "--ground-truth", camvid / TRUTH)
    network = REAL / "networks" / "espnetv2.yaml"
    stored, made = (
        json.loads(ssrvlad("evaluate", town, *known, *asked, *truth, *labelled)[1])
        for labelled in (
            ("--labels", "predicted_espnetv2"),
            ("--segmenter", network, "--segmenter-cache", tmp_path / "cache"),
        )
    )
    assert made["recall_at"]["1"] >= stored["recall_at"]["1"] - 0.02


def test_only_results_are_on_stdout_whatever_a_network_prints(ssrvlad, tmp_path, monkeypatch):
    """With --json each line of stdout is an object, though the network prints where it is built
    and where it labels."""
    (tmp_path / "loud.py").write_text(
        "from networks import Street\n"
        "class Loud(Street):\n"
        "    def forward(self, images):\n"
        "        print('labelling')\n"
        "        return super().forward(images)\n"
        "def loud():\n"
        "    print('built')\n"
        "    return Loud().eval()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    photos = write_photos(tmp_path / "photos", range(5), (64, 96))
    (tmp_path / "truth.json").write_text(json.dumps({"photos/1": ["photos/1"]}))
    names = "".join(f"{photos / name}.png\n" for name in "123")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(names.encode())))
    settings = tmp_path / "net.yaml"
    settings.write_text(f"network: loud:loud\nmean: [0, 0, 0]\nlabels_as: {SPACE}\n")
    truth = ("--ground-truth", tmp_path / "truth.json")
    for number, command in enumerate([
        ("labels", settings),
        ("encode", photos, "-o", tmp_path / "town"),
        ("query", tmp_path / "town", photos),
        ("locate", photos / "1.png", "--in", tmp_path / "town"),
        ("evaluate", tmp_path / "town", photos, *truth),
        ("loops", photos),
        ("loops", "-"),
    ]):  # fmt: skip
        sources._network.cache_clear()
        cache = ("--segmenter-cache", tmp_path / f"cache {number}")
        network = ("--segmenter", settings, *cache) if number else ()
        code, out, err = ssrvlad(*command, *network, "--json")
        assert code == 0, err
        assert out and all(isinstance(json.loads(line), dict) for line in out.splitlines()), command
        assert {"built", "labelling"} <= {*err}, command
