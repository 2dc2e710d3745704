"""Tracks: returns in another light, and what is none."""

import numpy as np
import pytest

from ssrvlad_torch.loops.tracks import Tracks

STREET = 150


def told(closeness, chance=0.02, accepted=()):
    """Whether the drive is told to return at each frame: a street, and then the same again, whose
    frames are so close to those of the first time; others are close by chance."""
    tracks, found = Tracks(), []
    rng = np.random.default_rng(0)
    for number in range(2 * STREET):
        near = rng.uniform(-chance, chance, number).astype(np.float32)
        near[-1:] = 1
        if number >= STREET:
            near[number - STREET] = closeness
        tracks.after(near, max(0, number - 50))
        found.append(tracks.returning)
        tracks.decided(number in accepted)
    return np.array(found)


CLOSED = range(STREET + 10, 2 * STREET)


def test_a_return_in_another_light_is_told_soon_and_as_long_as_it_lasts():
    found = told(0.3, accepted=CLOSED)
    assert not found[:STREET].any()
    assert found[STREET + 10 :].all()


def test_what_closes_no_loop_was_by_chance():
    """Tracks that the filter does not follow raise the level for all later ones."""
    assert not told(0.3)[STREET + 60 :].any()


@pytest.mark.parametrize("closeness", [0.0, 1.0])
def test_neither_a_new_place_nor_one_light_is(closeness):
    assert not told(closeness, accepted=CLOSED if closeness else ())[STREET + 25 :].any()


def test_where_places_look_alike_nothing_is_told():
    assert not told(0.6, chance=0.9).any()
