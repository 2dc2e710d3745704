"""Operating points by hand, and what the suggested threshold promises."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from test_curves import curve_of

from ssrvlad_torch import match
from ssrvlad_torch.evaluation.thresholds import (
    at_precision,
    at_recall,
    operating_points,
    queries_needed,
    suggested_point,
    wilson_low,
)


@pytest.fixture
def curve():
    """Right, right, wrong, right, right; five positives."""
    return curve_of([0.9, 0.8, 0.6, 0.4, 0.3], [1, 1, 0, 1, 1], 5)


def test_wilson_is_that_of_scipy():
    right, accepted = np.array([(r, n) for n in (1, 10, 73, 400) for r in (0, n // 2, n)], float).T
    expected = [
        binomtest(int(r), int(n)).proportion_ci(0.95, "wilson").low
        for r, n in zip(right, accepted, strict=True)
    ]
    np.testing.assert_allclose(wilson_low(right, accepted), expected, atol=1e-12)
    assert wilson_low(np.zeros(1), np.zeros(1)) == 0


def test_seventy_three_right_answers_are_enough_and_one_fewer_is_not():
    scores = np.arange(73, 0, -1) / 100
    assert suggested_point(curve_of(scores, [1] * 73, 73)).accepted == 73
    fewer = suggested_point(curve_of(scores[1:], [1] * 72, 72))
    assert fewer.accepted == 72 and fewer.precision_low < 0.95
    assert queries_needed() == 73


def test_the_suggestion_lies_between_scores():
    """Halfway to the first score that would spoil it; 0.5 and 0.25 are both wrong."""
    scores = [*[0.75] * 100, *[0.5] * 50, *[0.25] * 50]
    point = suggested_point(curve_of(scores, [1] * 100 + [0] * 100, 100))
    assert (point.score, point.accepted, point.recall) == (0.625, 100, 1.0)
    assert point.precision_low > 0.95


def test_match_accepts_at_the_suggested_threshold():
    """Above it, in float32, also where all scores that were measured are accepted."""
    references = torch.eye(2)
    queries = torch.tensor([[0.6, 0.8]]).repeat(100, 1)
    scores = match(queries, references, top=1).scores[:, 0].numpy()
    point = suggested_point(curve_of(scores, [1] * 100, 100))
    assert point.score < scores.min()
    assert bool((match(queries, references, 1, point.score).indices >= 0).all())


SCORES = st.sampled_from([-0.25, 0.0, 0.25, 0.5, 1.0])


@given(st.lists(st.tuples(SCORES, st.booleans()), min_size=1, max_size=30), st.floats(0.01, 1))
def test_operating_points_equal_a_search_over_thresholds(queries, fraction):
    scores = np.array([score for score, _ in queries])
    correct = np.array([right for _, right in queries])
    curve = curve_of(scores, correct, len(queries))
    counts = {t: (correct[scores >= t].sum(), (scores >= t).sum()) for t in set(scores)}
    precise = [t for t, (right, accepted) in counts.items() if right / accepted >= fraction]
    found = [t for t, (right, _) in counts.items() if right / len(queries) >= fraction]
    for point, expected in (
        (at_precision(curve, fraction), min(precise, default=None)),
        (at_recall(curve, fraction), max(found, default=None)),
    ):
        assert (point and point.score) == expected
        if point:
            assert point.accepted == counts[expected][1]
            assert point.precision == pytest.approx(counts[expected][0] / counts[expected][1])
    point = suggested_point(curve, fraction)
    low = {t: float(wilson_low(np.array(r), np.array(n))) for t, (r, n) in counts.items()}
    sure = [t for t in low if low[t] >= min(fraction, max(low.values()))]
    assert (point is None) == (not correct.any())
    if point:
        assert (scores >= point.score).sum() == (scores > point.score).sum() == point.accepted
        assert point.accepted == counts[min(sure)][1]


def test_all_points_as_a_mapping(curve):
    points = operating_points(curve)
    assert points["at_precision"].keys() == {"0.99", "1"}
    assert points["at_precision"]["1"]["score"] == 0.8
    assert points["at_recall"]["0.5"]["precision"] == 0.75
    assert points["suggested"]["accepted"] == 5 and points["suggested"]["precision_low"] < 0.95
    assert operating_points(curve_of([0.9], [0], 1))["suggested"] is None
