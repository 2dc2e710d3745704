"""`ssrvlad locate`."""

import json

import pytest

from ssrvlad_torch import Database
from ssrvlad_torch.encoding import source as sources


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


def test_locate_refuses_a_database_of_label_maps_and_a_network_of_code(ssrvlad, database, tmp_path):
    code, _, (line,) = ssrvlad("locate", tmp_path, "--in", database)
    assert code == 2
    assert "was not made from pictures; name a --segmenter" in line
    Database.open(database).add_origin(None, "key", "mynets:mine")
    (line,) = ssrvlad("locate", tmp_path, "--in", database)[2]
    assert line.endswith("was made by code: say --segmenter mynets:mine")
