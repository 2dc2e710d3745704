"""The synthetic city on disk: frames, poses and true matches; and what is refused."""

import json
import math

import numpy as np
import pytest
from helpers import refuses
from PIL import Image

from ssrvlad_torch.datasets.poses import read_poses
from ssrvlad_torch.datasets.synthetic_city import (
    QUERY,
    REFERENCE,
    TOUR,
    TOUR_ESTATES,
    Conditions,
    SyntheticCity,
    write_city,
    write_tour,
)
from ssrvlad_torch.taxonomy import palette

SIZE = (48, 64)


def test_a_written_tour_has_its_poses_beside_it(tmp_path):
    calls = []
    folder = write_tour(tmp_path, 7, seed=2, size=SIZE, progress=calls.append)
    frames = list(SyntheticCity(2, TOUR_ESTATES).traverse(7, size=SIZE, turns=TOUR))
    assert sorted(path.name for path in folder.iterdir()) == [f"{f.name}.png" for f in frames]
    poses = read_poses(tmp_path / "poses.csv")
    assert poses == {f"tour/{frame.name}": frame.pose for frame in frames}
    with Image.open(folder / "000006.png") as image:
        assert np.array_equal(np.asarray(image), frames[6].labels)
    assert calls == [1] * 7


def test_a_written_city_is_its_frames_their_poses_and_true_matches(tmp_path):
    calls = []
    files = write_city(tmp_path, 12, 2, SIZE, progress=lambda *done: calls.append(done))
    assert calls == [(1,)] * 24
    for folder, conditions in ((files / "reference", REFERENCE), (files / "query", QUERY)):
        paths = sorted(folder.iterdir())
        frames = list(SyntheticCity(2).traverse(12, conditions, SIZE))
        assert [path.name for path in paths] == [f"{frame.name}.png" for frame in frames]
        for path, frame in zip(paths, frames, strict=True):
            with Image.open(path) as image:
                assert image.mode == "P"
                assert np.array_equal(np.asarray(image), frame.labels)
                colours = np.asarray(image.convert("RGB"))
            assert np.array_equal(colours, palette("cityscapes-trainids")[frame.labels])
    assert (files / "poses.csv").read_text().startswith("frame,x,y,heading\n")
    poses = read_poses(files / "poses.csv")
    truth = json.loads((files / "ground_truth.json").read_text())
    assert list(truth) == [name for name in poses if name.startswith("query/")]
    for query, matches in truth.items():
        assert matches == [
            name
            for name, pose in poses.items()
            if name.startswith("reference/")
            and math.dist(pose[:2], poses[query][:2]) <= 5
            and abs(math.remainder(pose[2] - poses[query][2], math.tau)) < math.pi / 4
        ]
        assert matches


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SyntheticCity(-1), "seed: got -1"),
        (lambda: SyntheticCity().traverse(0), "frames: got 0, expected at least 1"),
        (lambda: SyntheticCity().traverse(1, size=(8, 64)), r"size: got \(8, 64\)"),
        (lambda: SyntheticCity().traverse(1, labels_as="camvid-11"), "labels_as: got 'camvid-11'"),
        (lambda: Conditions(season="spring"), "season: got 'spring', expected one of"),
        (lambda: Conditions(spacing=0), "spacing: got 0, expected metres > 0"),
        (lambda: Conditions(noise=math.nan), "noise: got nan"),
        (lambda: Conditions(seed=-1), "seed: got -1"),
    ],
)
def test_wrong_arguments_are_refused_by_name(call, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refuses(message, call)
    assert not list(tmp_path.iterdir())
