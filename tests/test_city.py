"""What a drive through the synthetic city shows: its route, its streets and what moves in them."""

import functools
import hashlib
import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

from ssrvlad_torch.datasets.city.streets import camera_poses
from ssrvlad_torch.datasets.synthetic_city import (
    LEFT,
    QUERY,
    RIGHT,
    STRAIGHT,
    TOUR,
    Conditions,
    SyntheticCity,
)
from ssrvlad_torch.taxonomy import CATEGORIES, label_space

SIZE = (48, 64)
SMALL = (24, 48)
DYNAMIC = {24, 25, 26, 27, 28, 33}
VEGETATION = 21


@functools.cache
def drive(frames=10, seed=0, labels_as="cityscapes-ids", size=SIZE, **conditions):
    city = SyntheticCity(seed)
    return list(city.traverse(frames, Conditions(**conditions), size, labels_as))


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


@pytest.mark.parametrize("turn", [LEFT, RIGHT])
def test_four_turns_lead_round_a_block_to_the_beginning(turn):
    """Left round a block; to the right the first street is crossed where the drive began."""
    poses = poses_of([turn] * 5)
    near = np.hypot(*(poses[20:] - poses[0])[:, :2].T) < 3
    again = poses[20:][near]
    assert len(again)
    assert np.cos(again[:, 2]).max() > 0.99
    assert np.ptp(np.unwrap(poses[:, 2])) > 1.9 * math.pi


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
    (usual,), (moved,) = drive(1), drive(1, lateral_offset=0.7, heading_offset=10)
    assert usual.pose.heading == 0
    assert moved.pose.y - usual.pose.y == pytest.approx(0.7)
    assert math.degrees(moved.pose.heading) == pytest.approx(10)
    swaying = camera_poses(0, Conditions(heading_jitter=3.0))
    sway = np.degrees([pose.heading for pose in itertools.islice(swaying, 60)])
    assert 1.5 < sway.std() < 4.5
    assert np.abs(np.diff(sway)).max() < 5


def test_more_traffic_shows_more_of_it():
    none, usual, heavy = (
        np.isin(stack(drive(12, traffic=t)), list(DYNAMIC)).mean() for t in (0, 1, 3)
    )
    assert 0 == none < usual < heavy


def test_winter_bares_the_trees_and_nothing_else():
    """Where summer and winter differ, one of them shows a tree."""
    seasons = ("summer", "winter")
    summer, winter = (stack(drive(20, season=s, traffic=0, spacing=6)) for s in seasons)
    assert (winter == VEGETATION).sum() < 0.8 * (summer == VEGETATION).sum()
    differing = summer != winter
    assert ((summer == VEGETATION) | (winter == VEGETATION))[differing].all()


def test_a_long_drive_shows_every_category_at_even_spacing_and_turns():
    frames = drive(120, size=(120, 160))
    labels, ids = stack(frames), set(np.unique(stack(frames)))
    categories = {c.category for c in label_space("cityscapes-ids").classes if c.id in ids}
    assert categories >= set(CATEGORIES)
    assert ids >= DYNAMIC
    assert (labels[:, :10] == 23).mean() > 0.4
    assert (labels[:, -10:] == 7).mean() > 0.6
    assert not np.isin(labels[:, 70:], 23).any()
    assert not np.isin(labels[:, :50], (6, 7, 8, 9)).any()
    sample = labels[::4, ::4, ::4]
    assert np.triu((sample[:, None] == sample[None]).mean(axis=(2, 3)), 1).max() < 0.97
    poses = np.array([frame.pose for frame in frames])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert np.median(steps) == pytest.approx(3.0)
    assert steps.min() > 2.0 and steps.max() < 4.0
    assert np.ptp(poses[:, 2]) == pytest.approx(math.pi / 2)


def test_every_block_of_an_estate_looks_like_the_next():
    """Frames at the same place of two blocks agree as frames of other streets do not."""

    def best_agreement(estates):
        city = SyntheticCity(3, estates)
        conditions = Conditions(traffic=0, spacing=6)
        labels = stack(city.traverse(76, conditions, SMALL, "cityscapes-ids", [STRAIGHT] * 6))
        return np.array(
            [(labels[row] == labels[: row - 30]).mean((1, 2)).max() for row in (45, 60, 75)]
        )

    assert (best_agreement((0,)) > best_agreement(()) + 0.02).all()


@pytest.mark.parametrize("size", [(16, 16), (32, 32), (37, 90), (90, 37)])
def test_a_frame_has_any_size_asked_for(size):
    (frame,) = drive(1, size=size)
    assert (frame.labels.shape, frame.labels.dtype, frame.name) == (size, np.uint8, "000000")


def test_frames_are_the_same_in_another_process():
    code = (
        "import hashlib, numpy as np; from ssrvlad_torch.datasets.synthetic_city import *;"
        "labels = [f.labels for f in SyntheticCity(3).traverse(5, QUERY, (48, 64))];"
        "print(hashlib.sha256(np.stack(labels).tobytes()).hexdigest())"
    )
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = stack(SyntheticCity(3).traverse(5, QUERY, SIZE)).tobytes()
    assert there.stdout.strip() == hashlib.sha256(here).hexdigest()


def test_a_longer_drive_begins_like_a_shorter_one():
    short, long = drive(6), drive(12)
    assert np.array_equal(stack(short), stack(long[:6]))
    assert [f.pose for f in short] == [f.pose for f in long[:6]]


def test_labels_are_ids_of_the_label_space():
    """Train ids are the ids renamed."""
    spaces = [label_space(name) for name in ("cityscapes-ids", "cityscapes-trainids")]
    names = [{label.id: label.name for label in space.classes} for space in spaces]
    ids, train_ids = (stack(drive(labels_as=space.name, noise=3.0)) for space in spaces)
    for label, train in np.unique(np.stack((ids.ravel(), train_ids.ravel())), axis=1).T:
        assert names[1][train] in (names[0][label], "ignored")
