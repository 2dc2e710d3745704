"""A channel that the package does not know: a class and a line of `CHANNELS`, and nothing else."""

import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from drawings import SPACE
from networks import write_photos, write_settings

from ssrvlad_torch import Database
from ssrvlad_torch.channels import CHANNELS
from ssrvlad_torch.channels.channel import Channel, picture_of


class Brightness(Channel):
    """The mean of each cell of a picture, minus that of the picture."""

    name, shape, trust = "brightness", (24,), 3.0
    fingerprint = "4 x 6 means"

    def describe(self, views, columns=()):
        pictures = torch.from_numpy(np.stack([picture_of(view, self.name) for view in views]))
        cells = F.adaptive_avg_pool2d(pictures.float().mean(3)[:, None], (4, 6)).flatten(1)
        return F.normalize(cells - cells.mean(1, keepdim=True), dim=1)


@pytest.fixture(autouse=True)
def line(monkeypatch):
    monkeypatch.setitem(CHANNELS, "brightness", Brightness)


@pytest.fixture
def settings(tmp_path):
    return write_settings(tmp_path, f"labels_as: {SPACE}\n")


@pytest.fixture
def photos(tmp_path):
    return write_photos(tmp_path / "monday", range(30), (60, 80))


@pytest.fixture
def stored(ssrvlad, settings, photos, tmp_path):
    """A database with the channel, by `encode`."""
    path = tmp_path / "town.ssrdb"
    command = "encode", photos, "-o", path, "--segmenter", settings, "--channel", "brightness"
    assert ssrvlad(*command)[0] == 0
    return path


def test_encode_stores_it(stored, photos, ssrvlad):
    database = Database.open(stored)
    assert database.columns[1:] == (Brightness().column,)
    frames = database.load()
    assert list(frames.channels) == ["ssr-vlad", "brightness"]
    lengths = frames.channels["brightness"].norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(30))
    assert "brightness" in ssrvlad("db", "info", stored)[1]


def test_query_and_locate_use_it(stored, settings, ssrvlad, photos, tmp_path):
    today = write_photos(tmp_path / "today", range(4, 28), (60, 80))
    for options, weighed in (((), {"ssr-vlad", "brightness"}), (("--channel", "brightness"), ())):
        code, out, err = ssrvlad(
            "query", stored, today, "--segmenter", settings, *options, "--json"
        )
        assert code == 0, err
        first, *_ = answers = [json.loads(line) for line in out.splitlines()]
        assert len(answers) == 24
        best = {answer["query"]: answer["candidates"][0]["frame"] for answer in answers}
        assert best == {f"today/{n}": f"monday/{n}" for n in range(4, 28)}
        assert set(first["steps"]["weights"]["today"]) == set(weighed)
        assert first["estimate"]["accepted"] == 24
    code, out, _ = ssrvlad("locate", photos / "7.png", "--in", stored, "--json")
    place = json.loads(out)
    assert (code, place["place"], place["score_is"]) == (0, "monday/7", "fused score")


def test_loops_weigh_it(ssrvlad, settings, tmp_path):
    round_trips = write_photos(tmp_path / "monday", range(14), (60, 80))
    for number in range(14, 28):
        (round_trips / f"{number}.png").write_bytes(
            (round_trips / f"{number - 14}.png").read_bytes()
        )
    memory = tmp_path / "loops.ssrdb"
    code, out, _ = ssrvlad(
        "loops", round_trips, "--segmenter", settings, "--exclude", 8, "--memory", memory,
        "--channel", "brightness",
    )  # fmt: skip
    assert code == 0 and "monday/25: monday/11 " in out
    assert "brightness " in out.splitlines()[-1]
    columns = [column.name for column in Database.open(memory).columns]
    assert columns == ["ssr-vlad", "brightness"]


def test_a_changed_one_is_refused(monkeypatch, stored, photos, refusal):
    monkeypatch.setattr(Brightness, "fingerprint", "6 x 4 means")
    line = refusal("query", stored, photos)
    assert "by brightness are of 4 x 6 means, this version makes 6 x 4 means" in line
