"""How much the street around a frame repeats itself."""

import numpy as np

from ssrvlad_torch.loops.repeats import TRACK, Repeats


def fed(places, exclude=20):
    """The nearness of the frames of a drive to others of its street: 1 where places are equal."""
    repeats, places = Repeats(exclude), np.array(places)
    for number in range(len(places)):
        found = repeats.after((places[:number] == places[number]).astype(np.float32))
    return found


def test_frames_of_a_street_that_repeats_are_known():
    """Every seventh frame shows the same; the street of the first frames does not repeat."""
    found = fed([*range(100, 140), *(n % 7 for n in range(60)), *range(200, 240)])
    assert (found[45:95] == 1).all()
    assert (found[:20] == 0).all() and (found[-20:] == 0).all()


def test_single_frames_that_are_alike_are_no_repeat():
    places = [*range(100)]
    places[50] = places[42]
    assert fed(places).max() == np.float32(1 / TRACK)


def test_loops_farther_back_than_the_excluded_frames_are_no_repeats():
    assert fed([*range(60), *range(60)]).max() == 0
    assert np.isneginf(fed([1] * 50, exclude=0)).all()
