"""Tracks: returns in another light, and what is none."""

import numpy as np
import torch
from loop_streams import LIGHT, PLACES, RNG, drawn_anew, unit  # noqa: F401, a fixture

from ssrvlad_torch import SSRVLAD, LoopDetector
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
