"""`ssrvlad evaluate --method`, and `ssrvlad vocabulary`."""

import json

import numpy as np
import pytest
import torch
from drives import vpr_bench, write_maps, write_photos, write_truth
from helpers import write_street

from ssrvlad_torch.baselines.region_features import AlexNetPlaces365
from ssrvlad_torch.baselines.vocabulary import read_vocabulary
from ssrvlad_torch.baselines.weights import random_network

CAMVID = ("--labels-as", "camvid-11")


@pytest.mark.parametrize("method", ["hog", "tiny-image", "cohog"])
def test_another_method_is_evaluated_on_images(ssrvlad, tmp_path, method):
    photos = [write_photos(tmp_path / day, range(6)) for day in ("monday", "friday")]
    small = ("--set", "size=128") if method == "cohog" else ()
    arguments = (*photos, "--method", method, *small, "--tolerance-frames", 0)
    code, out, err = ssrvlad("evaluate", *arguments, "--json")
    report = json.loads(out)
    assert (code, err, report["method"]) == (0, [], method)
    assert report["recall_at"]["1"] == 1
    assert report["queries"] == report["references"] == 6
    assert report["encode_ms"].keys() == report["match_ms"].keys() == {"average", "min", "max"}
    assert report["bytes_a_reference"] > 0
    assert report["intervals"]["recall_at"]["1"] == [1, 1]
    assert "fingerprint" not in report
    assert not any(report["steps"]["standardise"].values()), "of six frames"
    assert set(report["steps"]["follow"].values()) == {"offline"}
    single = ("--no-standardise", "--no-sweep", "--follow", "no")
    told = ssrvlad("evaluate", *arguments, *single)[1]
    assert f"6 references, method {method}: not standardised, no sweep, followed: no" in told


def test_ssrvlad_as_a_method_gives_what_its_database_gives(ssrvlad, maps, database, tmp_path):
    queries = write_maps(tmp_path / "friday", range(3, 9))
    rest = (queries, *CAMVID, "--tolerance-frames", 1, "--json")
    plain = json.loads(ssrvlad("evaluate", database, *rest)[1])
    method = json.loads(ssrvlad("evaluate", maps, *rest, "--method", "ssr-vlad")[1])
    for key in ("recall_at", "auc_pr", "recall_at_100_precision", "queries", "references"):
        assert method[key] == plain[key]
    alone = json.loads(ssrvlad("evaluate", database, *rest, "--temporal", 0)[1])
    setting = ("--method", "ssr-vlad", "--set", "temporal=0")
    assert json.loads(ssrvlad("evaluate", maps, *rest, *setting)[1])["auc_pr"] == alone["auc_pr"]


def test_a_convention_of_all_pairs_takes_every_method(ssrvlad, maps, tmp_path):
    queries = write_maps(tmp_path / "friday", range(6))
    arguments = ("--method", "label-grid", *CAMVID, "--tolerance-frames", 0, "--json")
    code, out, _ = ssrvlad("evaluate", maps, queries, *arguments, "--convention", "vpr-tutorial")
    assert (code, json.loads(out)["recall_at"]["1"]) == (0, 1.0)


def test_truth_and_selection_are_the_same_for_every_method(ssrvlad, tmp_path):
    photos = [write_photos(tmp_path / day, range(6)) for day in ("monday", "friday")]
    truth = write_truth(tmp_path / "a.npy", vpr_bench([[1], [3], [5]]))
    odd = ("--every", 2, "--start", 1, "--ground-truth", truth, "--json")
    report = json.loads(ssrvlad("evaluate", *photos, "--method", "hog", *odd)[1])
    assert (report["queries"], report["references"], report["recall_at"]["1"]) == (3, 6, 1)


def test_random_weights_are_told_of(ssrvlad, tmp_path, monkeypatch):
    """The network is not the point here, so a small one stands for it."""
    from ssrvlad_torch.baselines import netvlad

    class Small(torch.nn.Module):
        size = 3

        def forward(self, images):
            return images.float().mean((2, 3))

    monkeypatch.setattr(netvlad, "NetVLADNetwork", Small)
    photos = write_photos(tmp_path / "monday", range(3))
    arguments = (photos, photos, "--method", "netvlad", "--random-weights", "--tolerance-frames", 0)
    code, out, _ = ssrvlad("evaluate", *arguments, "--json")
    assert (code, json.loads(out)["method"]) == (0, "netvlad (random weights)")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--method orb", "unknown method 'orb'; expected one of ssr-vlad, cohog"),
        ("--method orb --weights a", "unknown method 'orb'; expected one of ssr-vlad, cohog"),
        ("--method label-grid", "label-grid reads label maps; expected their --labels-as"),
        ("--method hog --set rows", "--set: expected NAME=VALUE, got 'rows'"),
        ("--method hog --set rows=[", "the value of --set rows is not plain YAML: "),
        ("--method hog --set rows=many", "method hog cannot take rows='many': "),
        ("--method hog --set rows=0", "the grid must be 1 x 1 or more, got 0 x 10"),
        ("--method hog --set depth=0", "method hog: got an unexpected keyword argument 'depth'"),
        ("--method hog --weights a.pt", "method hog takes no --weights"),
        ("--method ssr-vlad --random-weights", "method ssr-vlad takes no --random-weights"),
        ("--method netvlad --vocabulary a.npy", "method netvlad takes no --vocabulary"),
        ("--method netvlad --weights none.mat", "no weights at none.mat: expected vd16_pitts30k"),
        ("--set rows=3", "--set needs --method"),
        ("--weights a.pt", "--weights needs --method"),
        ("--random-weights", "--random-weights needs --method"),
        ("--method ssr-vlad --temporal 1", "use --set temporal=1"),
        ("--method hog --segmenter net.onnx", "encode a database with it and evaluate that"),
        ("--method hog --layout auto", "use ssrvlad compare, or name the two folders"),
    ],
)
def test_a_wrong_method_is_one_line(ssrvlad, maps, arguments, message):
    code, out, err = ssrvlad("evaluate", maps, maps, "--tolerance-frames", 0, *arguments.split())
    assert (code, out, len(err)) == (2, "", 1)
    assert message in err[0]


def test_a_damaged_image_is_named(ssrvlad, tmp_path):
    photos = write_photos(tmp_path / "monday", range(3))
    (photos / "001.png").write_bytes(b"no image")
    code, _, err = ssrvlad("evaluate", photos, photos, "--method", "hog", "--tolerance-frames", 0)
    assert code == 2
    assert "001.png: is no image file" in err[0]


def test_a_label_map_that_the_method_refuses_is_named(ssrvlad, maps, tmp_path):
    np.save(write_street(tmp_path / "friday" / "a.png", 0).with_suffix(".npy"), np.full((9, 9), 77))
    rest = ("--method", "label-grid", *CAMVID, "--tolerance-frames", 0, "--sequence", "q")
    code, _, err = ssrvlad("evaluate", maps, tmp_path / "friday" / "a.npy", *rest)
    assert (code, len(err)) == (2, 1)
    assert "label id 77 (81 pixels) is not in label space camvid-11" in err[0]


# ---- vocabulary


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

    settings = ("--set", "words=6", "--set", "regions=20", "--weights", weights)
    arguments = (photos, photos, "--method", "region-vlad", *settings, "--tolerance-frames", 0)
    code, out, _ = ssrvlad("evaluate", *arguments, "--vocabulary", words, "--json")
    assert (code, json.loads(out)["recall_at"]["1"]) == (0, 1)


def test_a_vocabulary_needs_weights_and_images(ssrvlad, weights, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    photos = write_photos(tmp_path / "monday", range(1))
    (tmp_path / "empty").mkdir()
    cases = {
        "no weights at": (photos,),
        "no images under": (tmp_path / "empty", "--weights", weights),
        "99999 words need": (photos, "--weights", weights, "--words", 99999),
    }
    for message, arguments in cases.items():
        code, _, err = ssrvlad("vocabulary", *arguments, "-o", tmp_path / "words.npy")
        assert (code, len(err)) == (2, 1)
        assert message in err[0]
    assert not (tmp_path / "words.npy").exists()
