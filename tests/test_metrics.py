"""Metrics against tables worked by hand and against a plain loop over thresholds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.metrics import evaluate, precision_recall, recall_rate

INF = math.inf


def rows(*matches):
    return [np.array(match, np.int64) for match in matches]


def curve_of(scores, correct, positives):
    return precision_recall(np.array(scores, float), np.array(correct, bool), positives)


@pytest.mark.parametrize(
    ("n", "wanted"),
    [(1, 1 / 3), (2, 2 / 3), (3, 2 / 3), (4, 3 / 3)],
)
def test_recall_rate_by_hand(n, wanted):
    """The first true match of the queries stands at place 1, 2 and 4; the last query has none."""
    indices = np.array([[5, 1, 2, 3], [1, 6, 2, 3], [9, 8, 0, 7], [0, 1, 2, 3]])
    truth = rows([5], [6, 100], [7], [])
    assert recall_rate(indices, truth, n) == pytest.approx(wanted)


def test_recall_rate_counts_a_query_once():
    assert recall_rate(np.array([[1, 2]]), rows([1, 2]), 2) == 1.0


def test_no_candidate_is_no_hit():
    assert recall_rate(np.array([[-1, -1], [0, -1]]), rows([3], [0]), 2) == 0.5


def test_recall_rate_without_true_matches_or_queries_is_nan():
    assert math.isnan(recall_rate(np.array([[1], [2]]), rows([], []), 1))
    assert math.isnan(recall_rate(np.zeros((0, 5), np.int64), [], 1))


@pytest.mark.parametrize(
    ("shape", "queries", "n", "message"),
    [
        ((2, 5), 2, 10, "RecallRate@10 needs 10 candidates a query, got 5"),
        ((2, 5), 2, 0, "at least 1, got 0"),
        ((2, 5), 3, 1, r"candidates for 3 queries, got \(2, 5\)"),
        ((2,), 2, 1, r"got \(2,\)"),
    ],
)
def test_recall_rate_refuses_what_does_not_fit(shape, queries, n, message):
    with pytest.raises(ValueError, match=message):
        recall_rate(np.zeros(shape, np.int64), rows([0], [0], [0])[:queries], n)


def test_curve_by_hand():
    """Right, right, wrong, right; one positive is never found."""
    curve = curve_of([0.9, 0.8, 0.6, 0.4], [1, 1, 0, 1], 4)
    np.testing.assert_allclose(curve.thresholds, [0.9, 0.8, 0.6, 0.4])
    np.testing.assert_allclose(curve.precision, [1, 1, 2 / 3, 3 / 4])
    np.testing.assert_allclose(curve.recall, [1 / 4, 2 / 4, 2 / 4, 3 / 4])
    assert curve.auc == pytest.approx(1 / 2 + 1 / 4 * (2 / 3 + 3 / 4) / 2)
    assert curve.recall_at_full_precision == 0.5


def test_all_right_is_one_and_all_wrong_is_zero():
    assert curve_of([0.3, 0.2, 0.1], [1, 1, 1], 3).auc == 1.0
    assert curve_of([0.3, 0.2, 0.1], [1, 1, 1], 3).recall_at_full_precision == 1.0
    assert curve_of([0.3, 0.2, 0.1], [0, 0, 0], 3).auc == 0.0
    assert curve_of([0.3, 0.2, 0.1], [0, 0, 0], 3).recall_at_full_precision == 0.0


def test_equal_scores_are_accepted_together():
    curve = curve_of([0.5] * 4, [1, 0, 1, 0], 3)
    assert curve.thresholds.tolist() == [0.5]
    assert curve.precision.tolist() == [0.5]
    assert curve.auc == pytest.approx(0.5 * 2 / 3)


def test_the_best_score_wrong_means_no_recall_at_full_precision():
    assert curve_of([0.9, 0.8, 0.7], [0, 1, 1], 3).recall_at_full_precision == 0.0


@pytest.mark.parametrize("correct", [[1, 0, 1], [0, 1, 1]])
def test_right_and_wrong_tied_at_the_top_mean_no_recall_at_full_precision(correct):
    """In whatever order the tied queries come."""
    curve = curve_of([0.9, 0.9, 0.7], correct, 3)
    assert curve.recall_at_full_precision == 0.0
    assert curve.precision.tolist() == [0.5, 2 / 3]


def test_a_query_without_candidate_is_never_accepted():
    curve = curve_of([0.9, -INF, -INF], [1, 0, 0], 3)
    assert curve.thresholds.tolist() == [0.9]
    assert curve.precision.tolist() == [1.0]
    assert curve.recall.tolist() == [1 / 3]


def test_negative_scores_are_scores():
    curve = curve_of([-0.5, -0.9], [1, 0], 2)
    assert curve.thresholds.tolist() == [-0.5, -0.9]
    assert curve.recall_at_full_precision == 0.5


def test_no_candidate_at_all_gives_an_empty_curve():
    curve = curve_of([-INF, -INF], [0, 0], 2)
    assert len(curve.precision) == len(curve.recall) == len(curve.thresholds) == 0
    assert curve.auc == 0.0
    assert curve.recall_at_full_precision == 0.0


def test_without_positives_recall_is_nan():
    curve = curve_of([0.9, 0.8], [0, 0], 0)
    assert np.isnan(curve.recall).all()
    assert curve.precision.tolist() == [0.0, 0.0]
    assert math.isnan(curve.auc)


SCORES = st.sampled_from([-INF, -0.25, 0.0, 0.25, 0.5, 0.5 + 2**-30, 1.0])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(SCORES, st.booleans()), max_size=30), st.integers(0, 5))
def test_curve_equals_a_loop_over_thresholds(queries, more_positives):
    scores = np.array([score for score, _ in queries], float)
    correct = np.array([right and score > -INF for score, right in queries], bool)
    positives = int(correct.sum()) + more_positives
    curve = precision_recall(scores, correct, positives)

    thresholds = sorted({score for score in scores if score > -INF}, reverse=True)
    assert curve.thresholds.tolist() == thresholds
    area, before = 0.0, None
    full = 0.0
    for place, threshold in enumerate(thresholds):
        accepted = scores >= threshold
        precision = (accepted & correct).sum() / accepted.sum()
        assert curve.precision[place] == pytest.approx(precision)
        if positives:
            recall = (accepted & correct).sum() / positives
            assert curve.recall[place] == pytest.approx(recall)
            last_recall, last_precision = before or (0.0, precision)
            area += (recall - last_recall) * (precision + last_precision) / 2
            before = recall, precision
            full = recall if precision == 1 else full
    if positives:
        assert curve.auc == pytest.approx(area)
        assert curve.recall_at_full_precision == pytest.approx(full)


def test_evaluate_by_hand():
    scores = np.array([[0.9, 0.1], [0.8, 0.7], [0.7, 0.2], [-INF, -INF], [0.6, 0.5]], np.float32)
    indices = np.array([[0, 1], [5, 2], [3, 4], [-1, -1], [1, 0]])
    truth = rows([0], [2], [3, 9], [4], [])
    metrics = evaluate(scores, indices, truth, at=(1, 2))
    assert metrics["recall_at"] == {"1": pytest.approx(2 / 4), "2": pytest.approx(3 / 4)}
    # accepted in turn: right, wrong, right, and a query that has no true match
    steps = [(1 / 4, 1), (1 / 4, 1 / 2), (2 / 4, 2 / 3), (2 / 4, 2 / 4)]
    assert metrics["auc_pr"] == pytest.approx(1 / 4 * 1 + 1 / 4 * (1 / 2 + 2 / 3) / 2), steps
    assert metrics["recall_at_100_precision"] == 1 / 4
    assert metrics["queries"] == 5
    assert metrics["queries_with_match"] == 4


def test_evaluate_without_positives_or_queries_has_no_figures():
    for indices, truth in ((np.zeros((2, 10), np.int64), rows([], [])), (np.zeros((0, 10)), [])):
        metrics = evaluate(np.ones(indices.shape), indices.astype(np.int64), truth)
        figures = (*metrics["recall_at"].values(), metrics["auc_pr"])
        assert all(math.isnan(figure) for figure in figures)
        assert math.isnan(metrics["recall_at_100_precision"])
        assert metrics["queries"] == len(indices)
        assert metrics["queries_with_match"] == 0


def test_evaluate_refuses_truth_of_other_queries():
    with pytest.raises(ValueError, match="candidates for 1 queries"):
        evaluate(np.ones((2, 10)), np.zeros((2, 10), np.int64), rows([0]))
