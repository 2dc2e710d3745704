"""The synthetic city: its route, its streets, what moves in them, its noise, and its files."""

import functools
import hashlib
import json
import math
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from ssrvlad_torch.cli.demo import Pair, chosen, draw_pairs
from ssrvlad_torch.datasets.city.streets import camera_poses
from ssrvlad_torch.datasets.pose_tables import read_poses
from ssrvlad_torch.datasets.synthetic_city import (
    LEFT,
    QUERY,
    REFERENCE,
    RIGHT,
    STRAIGHT,
    TOUR,
    TOUR_ESTATES,
    Conditions,
    SyntheticCity,
    write_city,
    write_tour,
)
from ssrvlad_torch.taxonomy import label_space, palette

SIZE = (48, 64)


@functools.cache
def drive(frames=10, labels_as="cityscapes-ids", size=SIZE, **conditions):
    return list(SyntheticCity().traverse(frames, Conditions(**conditions), size, labels_as))


def stack(frames):
    return np.stack([frame.labels for frame in frames])


def poses_of(turns, seed=0):
    return np.array(list(camera_poses(seed, Conditions(), turns)))


def test_a_route_turn_by_turn_ends_where_its_turns_do():
    shorter, longer = poses_of([LEFT]), poses_of([LEFT, STRAIGHT])
    assert len(shorter) < len(longer) < len(poses_of([LEFT, STRAIGHT, RIGHT]))
    np.testing.assert_array_equal(longer[: len(shorter)], shorter)
    frames = list(SyntheticCity(0).traverse(500, size=(16, 16), turns=[LEFT]))
    np.testing.assert_array_equal([frame.pose for frame in frames], shorter)


def test_the_tour_comes_back_in_both_directions():
    poses = poses_of(TOUR, seed=1)
    apart = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
    turned = np.cos(poses[:, None, 2] - poses[None, :, 2])
    earlier = np.tri(len(poses), k=-50, dtype=bool)
    same, opposite = (
        (earlier & (apart < 6) & facing).any(axis=1) for facing in (turned > 0.9, turned < -0.9)
    )
    assert 1000 < len(poses) < 1250
    assert 250 < same.sum() < 400
    assert 200 < (opposite & ~same).sum() < 400


def test_frames_are_the_same_in_another_process():
    code = (
        "import hashlib, numpy as np; from ssrvlad_torch.datasets.synthetic_city import *;"
        "labels = [f.labels for f in SyntheticCity(3).traverse(5, QUERY, (48, 64))];"
        "print(hashlib.sha256(np.stack(labels).tobytes()).hexdigest())"
    )
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = stack(SyntheticCity(3).traverse(5, QUERY, SIZE)).tobytes()
    assert there.stdout.strip() == hashlib.sha256(here).hexdigest()


def test_labels_are_ids_of_the_label_space():
    """Train ids are the ids renamed."""
    spaces = [label_space(name) for name in ("cityscapes-ids", "cityscapes-trainids")]
    names = [{label.id: label.name for label in space.classes} for space in spaces]
    ids, train_ids = (stack(drive(labels_as=space.name, noise=3.0)) for space in spaces)
    for label, train in np.unique(np.stack((ids.ravel(), train_ids.ravel())), axis=1).T:
        assert names[1][train] in (names[0][label], "ignored")


def assert_written(folder, frames):
    """Asserts that a folder holds frames, as palette images in colours of their label space."""
    paths = sorted(folder.iterdir())
    assert [path.name for path in paths] == [f"{frame.name}.png" for frame in frames]
    for path, frame in zip(paths, frames, strict=True):
        with Image.open(path) as image:
            assert image.mode == "P" and np.array_equal(np.asarray(image), frame.labels)
            colours = np.asarray(image.convert("RGB"))
        assert np.array_equal(colours, palette("cityscapes-trainids")[frame.labels])


def test_a_written_tour_has_its_poses_beside_it(tmp_path):
    calls = []
    folder = write_tour(tmp_path, 7, seed=2, size=SIZE, progress=calls.append)
    frames = list(SyntheticCity(2, TOUR_ESTATES).traverse(7, size=SIZE, turns=TOUR))
    assert_written(folder, frames)
    poses = read_poses(tmp_path / "poses.csv")
    assert poses == {f"tour/{frame.name}": frame.pose for frame in frames}
    assert calls == [1] * 7


def test_a_written_city_is_its_frames_their_poses_and_true_matches(tmp_path):
    calls = []
    files = write_city(tmp_path, 12, 2, SIZE, progress=calls.append)
    assert calls == [1] * 24
    for name, conditions in (("reference", REFERENCE), ("query", QUERY)):
        assert_written(files / name, list(SyntheticCity(2).traverse(12, conditions, SIZE)))
    poses = read_poses(files / "poses.csv")
    truth = json.loads((files / "ground_truth.json").read_text())
    assert list(truth) == [name for name in poses if name.startswith("query/")]
    for query, matches in truth.items():
        assert matches and matches == [
            name
            for name, pose in poses.items()
            if name.startswith("reference/")
            and math.dist(pose[:2], poses[query][:2]) <= 5
            and abs(math.remainder(pose[2] - poses[query][2], math.tau)) < math.pi / 4
        ]


# ---- the demo: the picture of queries and matches


@pytest.mark.parametrize(
    ("right", "matched", "expected"),
    [
        ([True] * 9, [True] * 9, [0, 4, 8]),
        ([True] * 5 + [False] + [True] * 3, [True] * 9, [0, 4, 5]),
        ([False] + [True] * 8, [True] * 9, [0, 4, 8]),
        ([True, True], [True, True], [0, 1]),
        ([True, False, True], [True, False, True], [0, 2]),
    ],
)
def test_a_wrong_match_is_among_them_if_there_is_one(right, matched, expected):
    assert chosen(right, matched, 3) == expected


def test_right_is_green_and_wrong_is_red():
    sky, road = np.full((48, 64), 10), np.full((48, 64), 0)
    space = label_space("cityscapes-trainids")
    names = ("query/000000", "reference/000000, score 0.50")
    sheets = [
        np.asarray(draw_pairs([Pair(sky, road, *names, right)] * 2, space))
        for right in (True, False)
    ]
    for sheet, verdict in zip(sheets, ((26, 127, 55), (207, 34, 46)), strict=True):
        found = {tuple(pixel) for pixel in np.unique(sheet.reshape(-1, 3), axis=0).tolist()}
        assert {verdict, (70, 130, 180), (128, 64, 128)} <= found
        assert (0, 0, 142) not in found
