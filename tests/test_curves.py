"""Curves against tables worked by hand, a plain loop over thresholds, and scikit-learn."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.evaluation.curves import rank, roc_auc

INF = math.inf


def precision_recall(scores, correct, positives, start=None):
    weights = np.ones(len(scores))
    return rank(scores, correct).curve(weights, np.asarray(positives, np.float64), start)


def curve_of(scores, correct, positives):
    return precision_recall(np.array(scores, float), np.array(correct, bool), positives)


SCORES = st.sampled_from([-INF, -0.25, 0.0, 0.25, 0.5, 0.5 + 2**-30, 1.0])


@given(st.lists(st.tuples(SCORES, st.booleans()), max_size=30), st.integers(0, 5))
@example([(0.3, True), (0.2, True), (0.1, True)], 0)  # all right
@example([(0.3, False), (0.2, False)], 3)  # all wrong
@example([(0.5, True), (0.5, False), (0.5, True), (0.5, False)], 1)  # one threshold
@example([(0.9, False), (0.8, True), (0.7, True)], 1)  # the best is wrong
@example([(0.9, False), (0.9, True), (0.7, True)], 1)  # right and wrong tied at the top
@example([(0.9, True), (-INF, False), (-INF, False)], 2)  # queries without candidate
@example([(-0.25, True), (-0.9, False)], 1)  # scores below zero
@example([(-INF, False), (-INF, False)], 2)  # no candidate at all
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


def test_the_figures_of_four_queries_equal_those_by_hand():
    """Right, right, wrong, right; four positives."""
    curve = curve_of([0.9, 0.8, 0.6, 0.4], [1, 1, 0, 1], 4)
    assert curve.average_precision == pytest.approx((1 + 1 + 3 / 4) / 4)
    assert curve.extended_precision == pytest.approx((1 + 1 / 2) / 2)
    assert roc_auc(curve, np.array(3.0), np.array(1.0)) == pytest.approx(2 / 3)
    # of a tie at the top the precision is that of the tie, and no threshold has precision 1
    assert curve_of([0.9, 0.9, 0.9, 0.7], [1, 0, 1, 1], 3).extended_precision == (2 / 3 + 0) / 2
    assert curve_of([0.9, 0.7], [0, 1], 2).extended_precision == 0.0


def test_roc_auc_is_nan_without_right_and_wrong_candidates():
    for correct in ([1, 1], [0, 0]):
        curve = curve_of([0.9, 0.8], correct, 2)
        right = float(sum(correct))
        assert math.isnan(roc_auc(curve, np.array(right), np.array(2 - right)))
    curve = curve_of([0.9, 0.8, -INF, -INF], [0, 1, 0, 0], 1)
    assert roc_auc(curve, np.array(1.0), np.array(3.0)) == pytest.approx(2 / 3)


@pytest.mark.parametrize("seed", range(20))
def test_scikit_learn_agrees_on_heavy_ties(seed):
    sklearn = pytest.importorskip("sklearn.metrics", reason="scikit-learn is not installed")
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, rng.integers(1, 12), 200) / 8 - 0.5
    correct = rng.random(200) < 0.2 + 0.6 * (scores - scores.min())
    correct[:2] = [True, False]
    right = int(correct.sum())
    curve = precision_recall(scores, correct, right, start=1.0)
    precision, recall, thresholds = sklearn.precision_recall_curve(correct, scores)
    np.testing.assert_allclose(curve.precision, precision[-2::-1], rtol=1e-12)
    np.testing.assert_allclose(curve.recall, recall[-2::-1], rtol=1e-12)
    np.testing.assert_array_equal(curve.thresholds, thresholds[::-1])
    assert curve.auc == pytest.approx(sklearn.auc(recall, precision), abs=1e-12)
    expected = sklearn.average_precision_score(correct, scores)
    assert curve.average_precision == pytest.approx(expected, abs=1e-12)
    found = roc_auc(curve, np.array(float(right)), np.array(200.0 - right))
    assert found == pytest.approx(sklearn.roc_auc_score(correct, scores), abs=1e-12)


QUERIES = st.lists(st.tuples(SCORES, st.booleans(), st.integers(0, 3)), max_size=20)


@given(QUERIES, st.sampled_from([None, 1.0]))
def test_a_weight_is_so_many_copies_of_a_query(queries, start):
    """Also where the queries of the highest scores have weight 0."""
    scores = np.array([score for score, _, _ in queries], float)
    correct = np.array([right and score > -INF for score, right, _ in queries], bool)
    weights = np.array([[weight for _, _, weight in queries]], np.int64).reshape(1, -1)
    positives = weights @ correct + 1.0
    weighted = rank(scores, correct).curve(weights.astype(float), positives, start)
    copied = precision_recall(
        np.repeat(scores, weights[0]), np.repeat(correct, weights[0]), int(positives[0]), start
    )
    for figure in ("auc", "average_precision", "recall_at_full_precision", "extended_precision"):
        assert getattr(weighted, figure)[0] == pytest.approx(getattr(copied, figure)), figure
