"""Errors of a simulated segmentation network."""

import numpy as np
import pytest
from helpers import refuses

from ssrvlad_torch.datasets.segmentation_noise import (
    ERRORS,
    SegmentationNoise,
    confuse,
    lose_poles,
    wobble,
)

ROAD, BUILDING, WALL, POLE, SKY = 7, 11, 12, 17, 23


@pytest.fixture
def street():
    """Sky over a building over a road, and a pole every ten pixels."""
    labels = np.full((60, 90), SKY, np.uint8)
    labels[20:40], labels[40:] = BUILDING, ROAD
    labels[10:45, 5::10] = POLE
    return labels


def noisy(noise, labels, seed=0):
    return noise.apply(labels, np.random.default_rng(seed))


def apply(add_error, strength, labels, seed=0):
    return add_error(labels, strength, np.random.default_rng(seed))


def test_equal_generators_make_equal_errors_on_a_copy(street):
    before, noise = street.copy(), SegmentationNoise(5.0)
    assert np.array_equal(noisy(noise, street), noisy(noise, street))
    assert (noisy(noise, street) != noisy(noise, street, 1)).any()
    assert np.array_equal(street, before)
    assert np.array_equal(noisy(SegmentationNoise(0.0), street), street)


@pytest.mark.parametrize("add_error", ERRORS)
def test_a_stronger_error_changes_more_pixels(street, add_error):
    changed = [
        np.mean([(apply(add_error, strength, street, n) != street).mean() for n in range(8)])
        for strength in (0.5, 1.0, 2.0, 4.0)
    ]
    assert 0 < changed[0] < changed[1] < changed[2] < changed[3]


def test_poles_are_filled_similar_classes_confused_and_none_invented(street):
    lost = apply(lose_poles, 5.0, street)
    assert np.array_equal(lost, np.broadcast_to(street[:, :1], street.shape))
    confused = apply(confuse, 5.0, street)
    assert set(confused[street == BUILDING]) == {BUILDING, WALL}
    assert set(confused[street == SKY]) == {SKY}
    assert set(np.unique(apply(wobble, 3.0, street))) <= set(np.unique(street))


@pytest.mark.parametrize("shape", [(1, 1), (16, 200), (33, 17)])
def test_noise_keeps_shape_and_dtype(shape):
    labels = np.full(shape, SKY, np.uint8)
    result = noisy(SegmentationNoise(), labels)
    assert (result.shape, result.dtype) == (shape, np.uint8)


@pytest.mark.parametrize("strength", [-1.0, float("nan"), float("inf")])
def test_a_negative_or_infinite_strength_is_refused(strength):
    refuses(r"noise strength: got .*, expected a finite number >= 0", SegmentationNoise, strength)
