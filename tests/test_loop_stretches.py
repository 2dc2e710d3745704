"""Stretches: where a stream breaks, and what is recognised across."""

import numpy as np
import pytest
from loop_streams import LIGHT, PLACES, RNG, unit

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.reference import GAP, LEAST_FRAMES, LIKE, is_gap, likeness

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
    found = []
    for name, later in (("drive", HOUR), ("night", HOUR), ("drive", 51.0)):
        loops = LoopDetector(head=HEAD)
        show(loops, DAY, 0)
        found.append(closed(show(loops, NIGHT, later, name)))
    assert found[0] == found[1] and len(found[0]) > 50
    assert not found[2], "within one light, another light is no place seen before"


def test_a_pause_at_the_same_view_is_no_break():
    vectors = views([*range(100), *range(99, 140), *range(20, 80)])
    results = []
    for pause in (0, HOUR):
        loops = LoopDetector(head=HEAD)
        results.append([*show(loops, vectors[:100], 0), *show(loops, vectors[100:], 40 + pause)])
    assert results[0] == results[1]
    assert len(closed(results[0])) > 20


@pytest.mark.parametrize("signs", [False, True])
def test_a_frame_that_does_not_go_on_is_elsewhere(signs):
    """Each frame is half like the one before; the next goes on, stands still, or is far ahead."""
    street = np.random.default_rng(0).normal(size=(200, 512)).astype(np.float32)
    drive = street[:-1] + street[1:]
    if signs:
        drive = np.packbits(drive > 0, axis=1).reshape(-1, 8, 8)
    before = drive[:50]
    for row, elsewhere in ((50, False), (49, False), (47, False), (60, True), (190, True)):
        alike = likeness(np.concatenate((before, drive[row : row + 1])))
        assert (alike < LIKE) == elsewhere


def test_a_gap_is_long_for_light_and_for_the_stream():
    steady = np.arange(LEAST_FRAMES) / 3
    assert is_gap(steady, steady[-1] + 1.1 * GAP)
    assert not is_gap(steady, steady[-1] + 0.9 * GAP)
    assert not is_gap(steady[1:], steady[-1] + HOUR), "too few to know what is usual"
    assert not is_gap(HOUR * steady, HOUR * (steady[-1] + 1)), "one frame in twenty minutes"
    assert not is_gap(steady, np.nan)
    assert not is_gap(np.full(LEAST_FRAMES, np.nan), HOUR)
    for unknown in (0, 7, -1):
        some = np.append(steady, steady[-1] + np.diff(steady)[0])
        some[unknown] = np.nan
        assert is_gap(some, np.nanmax(some) + HOUR)


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
    for one, other in zip(got, expected, strict=True):
        assert one[:3] == other[:3]
        assert (one.probability or 0) == pytest.approx(other.probability or 0, abs=0.01)
    assert len(closed(got)) > 50
