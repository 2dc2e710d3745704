"""Features of a network through the commands: stored, fused, cached, refused."""

import json

import numpy as np
import pytest
import torch
from drawings import SPACE
from networks import write_photos, write_street

from ssrvlad_torch import Database, LoopDetector, Map
from ssrvlad_torch.channels.channel import View
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.datasets.frame_file import FrameFile
from ssrvlad_torch.datasets.image_files import read_image
from ssrvlad_torch.encoding import source as sources
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.segmentation.onnx_network import OnnxNetwork
from ssrvlad_torch.segmentation.segmenter import Segmenter
from ssrvlad_torch.stages.features import SHAPE

SETTINGS = f"network: net.onnx\nmean: [0, 0, 0]\nstd: [1, 1, 1]\nlabels_as: {SPACE}\n"


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("street") / "net.onnx").read_bytes()


@pytest.fixture
def photos(graph, tmp_path):
    """``monday``, 32 photos, ``today``, the same, and ``net.yaml``, a network with features."""
    (tmp_path / "net.onnx").write_bytes(graph)
    (tmp_path / "net.yaml").write_text(f"{SETTINGS}")
    for drive in ("monday", "today"):
        write_photos(tmp_path / drive, range(32), (96, 128))
    return tmp_path


@pytest.fixture
def town(photos, ssrvlad):
    given = ("--segmenter", photos / "net.yaml", "--workers", 1)
    code, _, err = ssrvlad("encode", photos / "monday", "-o", photos / "town", *given)
    assert (code, err) == (0, [])
    return photos / "town"


@pytest.fixture
def runs(monkeypatch):
    """The number of pictures that graphs are given."""
    pictures, forward = [0], OnnxNetwork.forward

    def counted(network, images, names=()):
        pictures[0] += len(images)
        return forward(network, images, names)

    monkeypatch.setattr(OnnxNetwork, "forward", counted)
    return pictures


def pictures_of(folder):
    return [read_image(FrameFile("", str(n), folder / f"{n}.png")) for n in range(32)]


def test_features_are_stored_by_default(town, photos, ssrvlad):
    database, segmenter = Database.open(town), Segmenter.load(photos / "net.yaml")
    assert [column.name for column in database.columns] == ["ssr-vlad", "features", "hog"]
    assert database.columns[1][1:] == (segmenter.features.fingerprint, SHAPE, "uint8")
    stored = database.load().channels["features"]
    said = segmenter.segment(pictures_of(photos / "monday"), features=True)
    assert torch.equal(stored, torch.from_numpy(np.stack([each.features for each in said])))
    frames = [View("", picture=image) for image in pictures_of(photos / "monday")]
    assert torch.equal(database.load().channels["hog"], HOG().describe(frames))
    assert database.damage() == []
    network = ("--segmenter", photos / "net.yaml")
    again = ("encode", photos / "monday", photos / "today", "-o", town, *network)
    code, out, _ = ssrvlad(*again)
    assert code == 0
    assert "32 frames encoded" in out and "32 already there" in out
    (photos / "monday" / "32.png").write_bytes(b"no picture")
    assert ssrvlad(*again)[0] == 3
    (photos / "monday" / "32.png").unlink()
    for option in ("ssr-vlad", "hog", "features"):
        given, other = (*network, "--channel", option), photos / option
        assert ssrvlad("encode", photos / "monday", "-o", other, *given)[0] == 0
        assert {column.name for column in Database.open(other).columns} == {"ssr-vlad", option}


def test_queries_use_features(town, photos, ssrvlad, refusal):
    network, found = ("--segmenter", photos / "net.yaml"), {}
    query = ("query", town, photos / "today", *network)
    for options in (
        (),
        ("--channel", "ssr-vlad"),
        ("--channel", "features"),
        ("--as-paper", "--channel", "ssr-vlad"),
    ):
        single = () if "--as-paper" in options else ("--follow", "no")
        code, out, _ = ssrvlad(*query, *single, *options, "--json")
        assert code == 0
        lines = [json.loads(line) for line in out.splitlines()]
        found[options] = lines[0]["steps"]["weights"]["today"]
        if not options:
            firsts = [line["candidates"][0]["frame"] for line in lines]
            assert firsts == [line["query"].replace("today", "monday") for line in lines]
    weights, *others = found.values()
    assert weights.keys() == {"ssr-vlad", "features", "hog"} and others == [{}, {}, {}]
    _, _, err = ssrvlad(*query, "--follow", "no", "--verbose")
    named = " + ".join(f"{name} {weight:.2f}" for name, weight in weights.items())
    assert f"fused: {named}" in err[-1]
    truth = ("--tolerance-frames", 0, "--follow", "no", "--json")
    _, out, _ = ssrvlad("evaluate", *query[1:], *truth)
    assert json.loads(out)["steps"]["weights"]["today"] == weights
    _, out, _ = ssrvlad("query", town, town, "--follow", "no", "--json")
    assert json.loads(out.splitlines()[0])["steps"]["weights"]["monday"].keys() == weights.keys()
    line = refusal(*query, "--temporal", "2")
    assert "features are signs, which have no temporal sum; expected --channel ssr-vlad" in line
    assert ssrvlad(*query, "--temporal", "2", "--channel", "ssr-vlad")[0] == 0


def test_a_map_uses_features(photos, maps, runs, ssrvlad):
    town = Map.open(photos / "town", photos / "net.yaml")
    assert town.add(photos / "monday").encoded == 32
    picture, before = photos / "today" / "7.png", runs[0]
    answer = town.locate(picture)
    assert (answer.candidates[0].frame, runs[0]) == ("monday/7", before + 1)
    code, out, err = ssrvlad("locate", picture, "--in", photos / "town")
    assert code == 0 and out.startswith("today/7: monday/7 (confidence ")
    assert err[-1].endswith("Matched as single frames; details with --verbose")
    err = ssrvlad("locate", picture, "--in", photos / "town", "--verbose")[2]
    assert "fused: ssr-vlad 0.11 + features 0.67 + hog 0.22" in err[-1]
    found = json.loads(ssrvlad("locate", picture, "--in", photos / "town", "--json")[1])
    given = answer.candidates[0].score, answer.confidence
    assert given == pytest.approx((found["score"], found["confidence"]))
    lines = ssrvlad("locate", photos / "today", "--in", photos / "town", "--json")[1].splitlines()
    several = town.locate(sorted(photos.glob("today/*.png")), top=1)
    found = {line["picture"]: (line["place"], line["score"]) for line in map(json.loads, lines)}
    for file, answer in zip(sorted(photos.glob("today/*.png")), several, strict=True):
        place = answer.candidates[0]
        assert found[f"today/{file.stem}"] == (place.frame, pytest.approx(place.score, abs=1e-6))
    again = Map.open(photos / "town")
    assert again.locate(pictures_of(photos / "today")[9]).candidates[0].frame == "monday/9"
    with pytest.raises(ValueError, match="expected images and --segmenter"):
        again.query(maps)  # label maps are still none of its pictures
    for channel in ("features", "hog"):
        found = town.evaluate(photos / "today", tolerance_frames=0, channels=[channel])
        assert found.metrics["recall_at"]["1"] == 1
        alike = found.recognition.material.cosines(np.arange(32), np.arange(32))
        assert alike.argmax(1).tolist() == [*range(32)]


def test_an_encode_with_nothing_to_do_does_not_open_the_network(town, photos, ssrvlad, monkeypatch):
    """Until one of its files changes."""
    opened, open_network = [], sources.open_network
    monkeypatch.setattr(
        sources, "open_network", lambda name: opened.append(1) or open_network(name)
    )
    again = ("encode", photos / "monday", "-o", town, "--segmenter", photos / "net.yaml")
    assert ssrvlad(*again)[1].endswith("32 already there, 0 skipped\n") and not opened
    (photos / "monday" / "0.png").rename(photos / "monday" / "33.png")
    _, out, err = ssrvlad(*again)
    assert "1 frames encoded" in out and "0 is in" in err[0] and opened.pop()
    (photos / "net.yaml").write_text(SETTINGS.replace("[1, 1, 1]", "[1, 1, 2]"))
    assert "encode again" in ssrvlad(*again)[2][-1] and opened


def test_sequences_of_unequal_length_are_refused_before_a_picture_is_labelled(
    town, photos, runs, refusal
):
    (photos / "today" / "31.png").unlink()
    before = runs[0]
    line = refusal("evaluate", town, photos / "today", "--tolerance-frames", 1)
    assert "two sequences of equal length, got 31 query frames and 32 reference frames" in line
    assert runs[0] <= before + 2, "the network is probed alone"


def test_loops_use_features(photos, ssrvlad):
    memory = ("--memory", photos / "memory", "--exclude", 5)
    network = ("--segmenter", photos / "net.yaml")
    code, out, _ = ssrvlad("loops", photos / "monday", *network, *memory)
    assert code == 0
    assert "followed online, fused: ssr-vlad 0." in out and "features" in out
    database = Database.open(photos / "memory")
    assert [column.name for column in database.columns] == ["ssr-vlad", "features", "hog"]
    code, out, _ = ssrvlad("loops", photos / "today", *network, *memory, "--json")
    results = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and len(results) == 32
    later = [each for each in results if each["candidate"]]
    assert sum(each["candidate"].startswith("monday") for each in later) > 20
    again = LoopDetector.load(Database.open(photos / "memory"), LoopConfig(exclude=5))
    assert len(again) == 64


def test_wrong_use_of_channels(town, photos, maps, ssrvlad, refusal):
    network = ("--segmenter", photos / "net.yaml")
    plain = photos / "plain"
    labels = ("--labels-as", SPACE)
    message = refusal("encode", maps, "-o", plain, *labels, "--channel", "hog")
    assert "--channel hog needs images as SOURCE and --segmenter" in message
    assert message in refusal("loops", photos / "today", *labels, "--channel", "hog")
    assert not plain.exists()
    assert "expected images and a segmenter" in refusal("encode", maps, "-o", town)
    alone = ("encode", photos / "today", "-o", plain, *network, "--channel", "ssr-vlad")
    assert ssrvlad(*alone)[0] == 0
    assert "label maps alone" not in "".join(ssrvlad(*alone[:4], *network)[2])
    maps_first = ("encode", "-o", photos / "maps.ssrdb")
    assert ssrvlad(*maps_first, maps, *labels)[0] == 0
    notes = ["".join(ssrvlad(*maps_first, photos / "today", *network)[2]) for _ in range(2)]
    assert ["is of label maps alone" in each for each in notes] == [True, False]
    message = refusal("encode", photos / "today", "-o", plain, *network, "--channel", "hog")
    assert "holds ssr-vlad of every frame, not hog; encode a new database" in message
    features = ("--channel", "features")
    message = refusal("query", plain, photos / "today", *network, *features)
    assert "holds ssr-vlad of every frame, not features; encode a new database with" in message
    assert message.endswith(" --channel features")
    for source in (maps, plain):
        message = refusal("query", town, source)
        assert "expected images and --segmenter, or --channel ssr-vlad" in message
        assert ssrvlad("query", town, source, "--channel", "ssr-vlad")[0] == 0
    assert "--as-paper" in refusal("query", town, maps, *features, "--as-paper")


def test_features_of_another_network_are_refused(town, photos, refusal):
    other = photos / "other.yaml"
    other.write_text(f"{SETTINGS}features: [relu_1]\n")
    network = ("--segmenter", other)
    for command in (
        ("encode", photos / "today", "-o", town, *network),
        ("query", town, photos / "today", *network),
        ("locate", photos / "today", "--in", town, *network),
        ("loops", photos / "today", "--memory", town, *network),
        ("evaluate", town, photos / "today", "--tolerance-frames", 1, *network),
    ):
        line = refusal(*command)
        assert "stored descriptors by features are of 16 x 16 cells" in line
        assert "signs of relu_1" in line and "signs of relu_2" in line
    assert len(Database.open(town)) == 32
    with pytest.raises(ValueError, match="stored descriptors by features are of "):
        Map.open(town, Segmenter.load(other)).locate(photos / "today" / "7.png")


def test_a_module_and_its_graph_do_not_compare_and_why_is_told(photos, town, refusal):
    (photos / "module.yaml").write_text(SETTINGS.replace("net.onnx", "networks:Street"))
    line = refusal("query", town, photos / "today", "--segmenter", photos / "module.yaml")
    assert "signs of act.2" in line and "signs of relu_2" in line
    assert "encode again, with the file that will be deployed" in line
    assert "a module, its ONNX file and another size are different networks" in line
