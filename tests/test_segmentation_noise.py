"""Errors of a simulated segmentation network."""

import numpy as np
import pytest

from ssrvlad_torch.datasets.segmentation_noise import (
    ERRORS,
    add_errors,
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


def apply(add_error, strength, labels, seed=0):
    return add_error(labels, strength, np.random.default_rng(seed))


def test_equal_generators_make_equal_errors_on_a_copy(street):
    before, noisy = street.copy(), apply(add_errors, 5.0, street)
    assert np.array_equal(apply(add_errors, 5.0, street), noisy)
    assert (apply(add_errors, 5.0, street, 1) != noisy).any()
    assert np.array_equal(street, before)
    assert np.array_equal(apply(add_errors, 0.0, street), street)


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
