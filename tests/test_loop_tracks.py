"""Tracks: returns in another light, and what is none."""

import math

import numpy as np
import pytest
import torch
from loop_streams import LIGHT, PLACES, RNG, unit

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.channels.features import Features
from ssrvlad_torch.database.frames import FrameRecord

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
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
        frames = zip(records, torch.from_numpy(noisy), strict=True)
        return [loops.observe(record, vector) for record, vector in frames]

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
    same = [
        (result.reason, result.candidate) == (whole.reason, whole.candidate)
        for result, whole in zip(got, expected[stop:], strict=True)
    ]
    assert sum(result.accepted for result in expected[150:]) > 40
    assert np.mean(same) > 0.9
