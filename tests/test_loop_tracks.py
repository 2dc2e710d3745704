"""Tracks: returns in another light, and what is none."""

import math

import numpy as np
import pytest
import torch
from loop_streams import LIGHT, PLACES, RNG, unit

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.loops.reference import Tracks

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
STREET = 150


def told(closeness, chance=0.02, accepted=()):
    """Whether the drive is told to return at each frame: a street, and then the same again, whose
    frames are so close to those of the first time; others are close by chance."""
    tracks, found = Tracks(), []
    rng = np.random.default_rng(0)
    for number in range(2 * STREET):
        near = rng.uniform(-chance, chance, number)
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


@pytest.mark.parametrize("stop", [145, 155, 200])
def test_a_stream_that_was_saved_knows_what_chance_does(tmp_path, stop):
    """Before the light changes, just after, and later; by label maps and signs."""
    beside = Features("drawn")
    drawn = RNG.normal(size=(480, 8 * math.prod(beside.column.shape))).astype(np.float32)
    street = PLACES[:200] + PLACES[1:201]
    light = 0.35 * LIGHT + RNG.normal(0, 0.3 / 22, (230, 480))
    light[:150] -= 0.35 * LIGHT
    vectors = unit(np.concatenate((street[:150], street[40:120])) + light)
    signs = np.packbits(vectors @ drawn > 0, axis=1).reshape(-1, *beside.column.shape)

    def go(loops, rows):
        results = []
        for row in rows:
            vector = torch.from_numpy(vectors[row])
            described = {"ssr-vlad": vector, "features": torch.from_numpy(signs[row])}
            results.append(loops.observe(FrameRecord("drive", str(row)), described))
        return results

    expected = go(LoopDetector(head=HEAD, channels=[beside]), range(230))
    stopped = LoopDetector(head=HEAD, channels=[beside])
    go(stopped, range(stop))
    database = Database.create(tmp_path / "db", HEAD.config, columns=[beside.column])
    stopped.save(database)
    got = go(LoopDetector.load(database, head=HEAD), range(stop, 230))
    same = [one[:3] == other[:3] for one, other in zip(got, expected[stop:], strict=True)]
    assert sum(result.accepted for result in expected[150:]) > 40
    assert np.mean(same) > 0.9
