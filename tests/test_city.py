"""The synthetic city: its route, its streets, what moves in them, its noise, and its files."""

import functools
import hashlib
import itertools
import json
import math
import subprocess
import sys

import numpy as np
import pytest
from helpers import refuses
from PIL import Image

from ssrvlad_torch.datasets.city.streets import camera_poses
from ssrvlad_torch.datasets.pose_tables import read_poses
from ssrvlad_torch.datasets.segmentation_noise import ERRORS
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
from ssrvlad_torch.taxonomy import CATEGORIES, label_space, palette

SIZE = (48, 64)
DYNAMIC = {24, 25, 26, 27, 28, 33}
ROAD, BUILDING, WALL, POLE, VEGETATION, SKY = 7, 11, 12, 17, 21, 23


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


def test_offsets_move_and_turn_the_camera():
    (usual,), (aside,) = drive(1), drive(1, lateral_offset=0.7, heading_offset=10)
    assert usual.pose.heading == 0
    assert aside.pose.y - usual.pose.y == pytest.approx(0.7)
    assert math.degrees(aside.pose.heading) == pytest.approx(10)
    swaying = camera_poses(0, Conditions(heading_jitter=3.0))
    sway = np.degrees([pose.heading for pose in itertools.islice(swaying, 60)])
    assert 1.5 < sway.std() < 4.5
    assert np.abs(np.diff(sway)).max() < 5


def test_more_traffic_shows_more_of_it():
    none, usual, heavy = (
        np.isin(stack(drive(12, traffic=t)), list(DYNAMIC)).mean() for t in (0, 1, 3)
    )
    assert 0 == none < usual < heavy


def test_a_long_drive_shows_every_category_between_sky_and_road():
    labels = stack(drive(120, size=(120, 160)))
    ids = set(np.unique(labels))
    categories = {c.category for c in label_space("cityscapes-ids").classes if c.id in ids}
    assert categories >= set(CATEGORIES) and ids >= DYNAMIC
    assert (labels[:, :10] == SKY).mean() > 0.4 and (labels[:, -10:] == ROAD).mean() > 0.6
    assert not np.isin(labels[:, 70:], SKY).any()
    assert not np.isin(labels[:, :50], (6, 7, 8, 9)).any()


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


@pytest.fixture
def street():
    """Sky over a building over a road, and a pole every ten pixels."""
    labels = np.full((60, 90), SKY, np.uint8)
    labels[20:40], labels[40:] = BUILDING, ROAD
    labels[10:45, 5::10] = POLE
    return labels


def apply(add_error, strength, labels, seed=0):
    return add_error(labels, strength, np.random.default_rng(seed))


@pytest.mark.parametrize("add_error", ERRORS)
def test_a_stronger_error_changes_more_pixels(street, add_error):
    changed = [
        np.mean([(apply(add_error, strength, street, n) != street).mean() for n in range(8)])
        for strength in (0.5, 1.0, 2.0, 4.0)
    ]
    assert 0 < changed[0] < changed[1] < changed[2] < changed[3]


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


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SyntheticCity().traverse(0), "frames: got 0, expected at least 1"),
        (lambda: SyntheticCity().traverse(1, size=(8, 64)), r"size: got \(8, 64\)"),
        (lambda: SyntheticCity().traverse(1, labels_as="camvid-11"), "labels_as: got 'camvid-11'"),
        (lambda: Conditions(season="spring"), "season: got 'spring', expected one of"),
        (lambda: Conditions(spacing=0), "spacing: got 0, expected metres > 0"),
    ],
)
def test_wrong_arguments_are_refused_by_name(call, message):
    refuses(message, call)
