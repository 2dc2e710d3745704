"""Precision and recall of loops: worked by hand, and against a plain count."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.loops import LoopScore, loop_curve, score_loops, surest_point
from ssrvlad_torch.evaluation.thresholds import wilson_low

EAST, WEST = 0.0, math.pi


def drive(*places):
    """Poses of ``(x, heading)`` on a line."""
    return np.array([(x, 0.0, heading) for x, heading in places])


def test_a_drive_worked_by_hand():
    """Out over four places, a turn, back over them the other way, and out once more."""
    poses = drive(*((x, EAST) for x in (0, 10, 20, 30)), *((x, WEST) for x in (30, 20, 10, 0)))
    poses = np.concatenate((poses, drive((1, EAST), (11, EAST), (21, EAST), (31, EAST))))
    loops = np.array([-1] * 5 + [2, 3, -1] + [0, 6, -1, 1])
    score = score_loops(loops, poses, exclude=1, metres=2)
    assert score == LoopScore(accepted=5, right=3, revisits=5)
    assert (score.precision, score.recall) == (3 / 5, 3 / 5)


@pytest.mark.parametrize(
    ("places", "loops", "settings", "expected"),
    [
        # a distance equal to the tolerance is near
        ([(0, EAST), (5, EAST)], [-1, 0], {"metres": 5.0}, (1, 1, 1)),
        ([(0, EAST), (5, EAST)], [-1, 0], {"metres": 4.9}, (1, 0, 0)),
        # an unknown heading fits any
        ([(0, EAST), (0, WEST)], [-1, -1], {}, (0, 0, 0)),
        ([(0, EAST), (0, WEST), (0, math.nan)], [-1, -1, 0], {}, (1, 1, 1)),
        # frames without a position are left out
        ([(0, EAST), (math.nan, EAST), (0, EAST), (0, EAST)], [-1, 0, 1, 0], {}, (1, 1, 2)),
        # frames before the first are candidates only
        ([(0, EAST)] * 3, [-1, 0, 1], {"first": 2}, (1, 1, 1)),
        # frames of another sequence are not excluded
        ([(0, EAST)] * 3, [-1] * 3, {"exclude": 2}, (0, 0, 0)),
        ([(0, EAST)] * 3, [-1] * 3, {"exclude": 2, "sequences": "abb"}, (0, 0, 2)),
    ],
)
def test_loops_and_revisits_are_counted_by_distance_and_heading(places, loops, settings, expected):
    settings = {"exclude": 0, "metres": 1.0, **settings}
    assert score_loops(np.array(loops), drive(*places), **settings) == expected


def test_wrong_arguments_are_refused():
    for metres in (-1, math.inf):
        with pytest.raises(ValueError, match=f"0 metres or more and finite, got {metres}"):
            score_loops(np.array([-1]), drive((0, EAST)), 0, metres)
    with pytest.raises(ValueError, match=r"none of 2 frames has a pose.*poses\.csv"):
        score_loops(np.array([-1, 0]), np.full((2, 3), np.nan), 0, 5)


@given(st.integers(1, 30), st.integers(0, 5), st.floats(0, 4), st.integers(0, 2**31))
def test_the_counts_equal_a_plain_count(length, exclude, metres, seed):
    rng = np.random.default_rng(seed)
    poses = np.column_stack((rng.integers(0, 5, (length, 2)), rng.uniform(-9, 9, length)))
    loops = np.array([rng.integers(-1, max(1, row)) for row in range(length)])
    accepted = right = revisits = 0
    for row in range(length):
        earlier = [
            other
            for other in range(row - exclude)
            if math.dist(poses[row, :2], poses[other, :2]) <= metres
            and abs(math.remainder(poses[row, 2] - poses[other, 2], math.tau)) < math.pi / 4
        ]
        good = loops[row] >= 0 and math.dist(poses[row, :2], poses[loops[row], :2]) <= metres
        accepted, right = accepted + (loops[row] >= 0), right + good
        revisits += bool(earlier or good)
    assert score_loops(loops, poses, exclude, metres) == (accepted, right, revisits)


def test_the_surest_threshold_is_the_lowest_before_the_mistakes():
    """Twenty that are right from 7 down, then as many of which half are wrong."""
    strengths = np.linspace(7, 3, 40)
    right = np.arange(40) < 20
    right[20::2] = True
    point = surest_point(loop_curve(strengths, right, 50))
    assert (point.accepted, point.precision, point.recall) == (21, 1, 21 / 50)
    assert strengths[21] < point.threshold < strengths[20]
    assert point.precision_low == pytest.approx(21 / (21 + 1.959964**2))


@given(st.integers(0, 40), st.integers(0, 2**31))
def test_no_threshold_is_surer(count, seed):
    rng = np.random.default_rng(seed)
    curve = loop_curve(rng.integers(1, 9, count).astype(float), rng.random(count) < 0.8, 50)
    point = surest_point(curve)
    sure = wilson_low(curve.true_positives, curve.accepted)
    if not curve.true_positives.any():
        assert point is None
    else:
        assert point.precision_low == sure.max()
        assert point.accepted == curve.accepted[np.flatnonzero(sure == sure.max())[-1]]


def test_no_improbable_loop_is_suggested_but_where_there_is_no_other():
    strengths = np.array([0.9, 0.6, 0.4, 0.01])
    point = surest_point(loop_curve(strengths, np.ones(4, bool), 50))
    assert (point.accepted, 0.5 < point.threshold <= 0.6) == (2, True)
    point = surest_point(loop_curve(strengths, np.array([False, False, True, True]), 50))
    assert point.accepted == 4
    point = surest_point(loop_curve(np.zeros(4), np.ones(4, bool), 50))
    assert point.threshold == 0, "a threshold is a probability"


def test_a_loop_with_a_street_driven_the_other_way_is_a_revisit():
    """Else there would be more loops that are right than frames that return."""
    poses = drive(*((x, EAST) for x in range(4)), *((x, WEST) for x in (3, 2, 1, 0)))
    loops = np.array([-1] * 4 + [3, 2, 1, 0])
    score = score_loops(loops, poses, exclude=0, metres=0.4)
    assert score == LoopScore(accepted=4, right=4, revisits=4)
    assert score_loops(loops * 0 - 1, poses, exclude=0, metres=0.4).revisits == 0
