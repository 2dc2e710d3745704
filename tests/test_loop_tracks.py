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
    tracks, found = Tracks(50), []
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


def test_a_track_that_closes_no_loop_was_by_chance():
    """Tracks that the filter does not follow for long raise the level for all later ones."""
    found = told(0.3)
    assert found[STREET + 10 : STREET + 50].all()
    assert not found[STREET + 110 :].any()


def test_a_slow_stream_is_no_return():
    """Its excluded frames run beside the last ones as closely as older frames do."""
    tracks, rng, found = Tracks(50), np.random.default_rng(0), False
    for number in range(2 * STREET):
        near = rng.uniform(-0.02, 0.02, number)
        near[-1:] = 1
        if number >= STREET:
            near[-80:-1] = 0.3
        tracks.after(near, max(0, number - 50))
        found |= tracks.returning
        tracks.decided(accepted=False)
    assert not found


@pytest.mark.parametrize("closeness", [0.0, 1.0])
def test_neither_a_new_place_nor_one_light_is(closeness):
    assert not told(closeness, accepted=CLOSED if closeness else ())[STREET + 25 :].any()


def test_where_places_look_alike_nothing_is_told():
    assert not told(0.6, chance=0.9).any()


@pytest.mark.parametrize(("alone", "stands"), [(True, False), (True, True), (False, False)])
def test_a_new_place_explains_what_chance_does_by_label_maps_alone(alone, stands):
    """A stop is no chance."""
    tracks, rng = Tracks(50, alone), np.random.default_rng(0)
    assert tracks.explained == 0
    for number in range(2 * STREET):
        near = rng.uniform(0.2, 0.4, number)
        near[-1:] = 0.7
        if stands and 100 < number < 170:
            near[100:] = 0.7
        tracks.after(near, max(0, number - 50))
        tracks.decided(accepted=False)
    assert not tracks.returning
    assert 0.03 < tracks.explained < 0.1 if alone else tracks.explained == 0


BETWEEN = PLACES + np.roll(PLACES, -1, axis=0)


def alike(start, styles, strength=0.8, light=0.0):
    """Descriptors of new places, which are like those of the same style, but less than a frame is
    like the next."""
    return unit(BETWEEN[start : start + len(styles)] + strength * BETWEEN[styles] + light)


def test_places_no_more_alike_than_those_of_the_stream_close_no_loop():
    """A street of two parts that are alike, and a third; by another name, a street like the third;
    and last the third itself, in another light."""
    first, third = np.arange(300, 380), np.arange(380, 460)
    street = np.concatenate((alike(0, first), alike(80, first), alike(160, third)))
    loops = LoopDetector(head=HEAD)

    def go(name, vectors):
        noisy = unit(vectors + RNG.normal(0, 0.3 / 22, vectors.shape))
        records = (FrameRecord(name, f"{number:03d}") for number in range(len(noisy)))
        return [loops.observe(*each) for each in zip(records, torch.from_numpy(noisy), strict=True)]

    go("first", street)
    assert not any(result.accepted for result in go("second", alike(240, third[:60], 0.6)))
    assert sum(result.accepted for result in go("third", alike(160, third, light=0.2 * LIGHT))) > 50


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
