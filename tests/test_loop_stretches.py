"""Stretches: where a stream breaks, and what is recognised across."""

import math

import numpy as np
import pytest
from loop_streams import LIGHT, PLACES, RNG, drawn_anew, unit  # noqa: F401, a fixture

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.loops.config import LoopConfig

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")
HOUR = 3600.0


def show(loops, vectors, start, sequence="drive"):
    """Shows descriptors, three a second from a time on."""
    first = len(loops)
    return [
        loops.update(vector, f"{sequence}/{first + n}", start + n / 3)
        for n, vector in enumerate(vectors)
    ]


def closed(results):
    return [(r.frame.split("/")[1], r.candidate.split("/")[1]) for r in results if r.accepted]


def views(places, noise=0.002, light=0.0):
    """Descriptors of places, each half like the next."""
    at = np.asarray(places)
    drawn = RNG.normal(0, noise, (len(at), PLACES.shape[1]))
    return unit(PLACES[at] + PLACES[at + 1] + light + drawn)


DAY, NIGHT = views(range(150)), views(range(40, 120), 0.02, LIGHT)


def test_after_a_gap_one_name_is_as_good_as_two():
    loops = []
    for name, later in (("drive", HOUR), ("night", HOUR), ("drive", 51.0)):
        detector = LoopDetector(head=HEAD)
        show(detector, DAY, 0)
        loops.append(closed(show(detector, NIGHT, later, name)))
    assert loops[0] == loops[1] and len(loops[0]) > 50
    assert not loops[2], "within one light, another light is no place seen before"


@pytest.mark.parametrize(
    ("frames", "step", "pause", "breaks"),
    [
        (150, 1 / 3, 700.0, True),
        (150, 1 / 3, 500.0, False),  # the light is still the same
        (19, 1 / 3, HOUR, False),  # too few frames to know what is usual
        (150, 0.3 * HOUR, HOUR, False),  # a frame in twenty minutes
        (150, math.nan, HOUR, False),
    ],
)
def test_a_gap_is_long_for_light_and_for_the_stream(frames, step, pause, breaks):
    """Where a stream breaks, what comes is as of another sequence."""
    answers = []
    for name in ("day", "night"):
        loops = LoopDetector(head=HEAD)
        for n in range(frames):
            loops.update(DAY[n], f"day/{n}", n * step)
        later = (frames - 1) * step + pause
        for n, vector in enumerate(NIGHT):
            result = loops.update(vector, f"{name}/{frames + n}", later + n / 3)
            answers.append((name, result.reason, result.candidate, result.confidence))
    day, night = ([answer[1:] for answer in answers if answer[0] == n] for n in ("day", "night"))
    assert (day == night) == breaks


@pytest.mark.parametrize("stop", [149, 150, 151, 200])
def test_a_stream_that_was_saved_goes_on_as_one_that_was_not(tmp_path, stop):
    """Just before a gap, at it, just after it, and later."""
    vectors = np.concatenate((DAY, NIGHT))
    stamps = np.concatenate((np.arange(150) / 3, HOUR + np.arange(80) / 3))

    def go(loops, rows):
        return [loops.update(vectors[n], f"drive/{n}", stamps[n]) for n in rows]

    loops = LoopDetector(LoopConfig(sweep=False), HEAD)
    expected = go(loops, range(230))
    stopped = LoopDetector(LoopConfig(sweep=False), HEAD)
    got = go(stopped, range(stop))
    database = Database.create(tmp_path / "db", HEAD.config)
    stopped.save(database)
    got += go(LoopDetector.load(database, stopped.config, HEAD), range(stop, 230))
    for result, whole in zip(got, expected, strict=True):
        assert (result.reason, result.candidate) == (whole.reason, whole.candidate)
        assert (result.confidence or 0) == pytest.approx(whole.confidence or 0, abs=0.01)
    assert len(closed(got)) > 50
