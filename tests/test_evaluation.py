"""Outcomes, curves, thresholds and metrics against tables worked by hand, plain loops, scikit-learn
and VPR-Bench; their intervals against resamples that are evaluated one by one."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from helpers import refuses
from hypothesis import example, given
from hypothesis import strategies as st
from layout_copies import frozen_corridor, needs_vpr_bench, stored_results
from scipy.stats import binomtest

from ssrvlad_torch import match
from ssrvlad_torch.evaluation import thresholds as bootstrapping
from ssrvlad_torch.evaluation.curves import judge, rank, roc_auc
from ssrvlad_torch.evaluation.metrics import FIGURES, evaluate, precision_recall_curve
from ssrvlad_torch.evaluation.thresholds import at_precision, at_recall, suggested_point, wilson_low

INF = math.inf


def rows(*matches):
    return [np.array(match, np.int64) for match in matches]


def test_an_unknown_convention_is_refused():
    message = "convention must be one of .*, got 'sklearn'"
    refuses(
        message, evaluate, np.ones((1, 1)), np.zeros((1, 1)), [[0]], convention="sklearn", at=()
    )


@pytest.mark.parametrize(
    ("results", "count"),
    [(lambda: [frozen_corridor()], 1), pytest.param(stored_results, 4, marks=needs_vpr_bench)],
)
def test_the_stored_results_of_vpr_bench_are_reproduced(results, count):
    checked = [*results()]
    assert len(checked) == count
    for stored in checked:
        metrics = evaluate(stored.scores, stored.candidates, stored.truth, convention="vpr-bench")
        found = {
            "auc_pr": metrics["auc_pr"],
            "rr": metrics["recall_at"],
            "r_at_100p": metrics["recall_at_100_precision"],
            "ep": metrics["extended_precision"],
        }
        assert found.keys() == stored.expected.keys()
        for name, figure in found.items():
            assert figure == pytest.approx(stored.expected[name], abs=1e-9), (stored.name, name)


HANDMADE = {
    "scores": np.array([[0.9], [0.8], [0.7], [0.6]]),
    "indices": np.array([[5], [1], [2], [3]]),
    "truth": rows([0], [1], [2], []),
}
"""Wrong, right, right, and a query of an unknown place that is accepted last."""


@pytest.mark.parametrize(
    ("convention", "counted", "positives"), [("exact", 3, 3), ("vpr-bench", 4, 2)]
)
def test_the_metrics_of_each_convention_equal_those_by_hand(convention, counted, positives):
    """Of an unknown place only precision suffers, and only where the query is accepted."""
    metrics = evaluate(**HANDMADE, at=(1,), convention=convention)
    assert metrics["convention"] == convention
    assert metrics["recall_at"] == {"1": 2 / counted}
    step = 1 / positives
    expected = {
        "auc_pr": step * (0 + 1 / 2) / 2 + step * (1 / 2 + 2 / 3) / 2,
        "average_precision": step * (1 / 2) + step * (2 / 3),
        "recall_at_100_precision": 0.0,
        "extended_precision": 0.0,
        "roc_auc": 1 / 2,
    }
    assert {name: metrics[name] for name in expected} == pytest.approx(expected)
    outcomes = judge(HANDMADE["scores"], HANDMADE["indices"], HANDMADE["truth"])
    curve = precision_recall_curve(outcomes, convention)
    assert curve.precision.tolist() == [0, 1 / 2, 2 / 3, 2 / 4]
    assert curve.recall.tolist() == [0, step, 2 * step, 2 * step]


@pytest.mark.parametrize("resamples", [0, 20])
@pytest.mark.parametrize(
    ("convention", "scores", "truth", "area"),
    [
        ("exact", np.zeros((0, 1)), rows(), math.nan),
        ("vpr-bench", np.zeros((0, 1)), rows(), math.nan),
        ("exact", np.ones((2, 1)), rows([], []), math.nan),
        ("vpr-bench", np.ones((2, 1)), rows([], []), math.nan),
        ("exact", np.full((2, 1), -INF), rows([0], [1]), 0),
        ("vpr-bench", np.full((2, 1), -INF), rows([0], [1]), math.nan),
        ("exact", np.ones((2, 1)), rows([0], [1]), 1 / 4),
        ("vpr-bench", np.ones((2, 1)), rows([0], [1]), 3 / 4),
    ],
)
def test_no_queries_positives_or_candidates_and_ties_have_an_area(
    convention, scores, truth, area, resamples
):
    indices = np.where(scores > -INF, 0, -1)
    result = evaluate(scores, indices, truth, (1,), convention, resamples=resamples)
    assert result["auc_pr"] == pytest.approx(area, nan_ok=True)
    assert ("intervals" in result) == bool(resamples)


def curve_of(scores, correct, positives, start=None):
    ranking = rank(np.array(scores, float), np.array(correct, bool))
    return ranking.curve(np.ones(len(scores)), np.array(positives, float), start)


ANY_SCORE = st.sampled_from([-INF, -0.25, 0.0, 0.25, 0.5, 0.5 + 2**-30, 1.0])


@given(st.lists(st.tuples(ANY_SCORE, st.booleans()), max_size=30), st.integers(0, 5))
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
    curve = curve_of(scores, correct, positives)

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


@pytest.mark.parametrize("seed", range(20))
def test_scikit_learn_agrees_on_heavy_ties(seed):
    sklearn = pytest.importorskip("sklearn.metrics", reason="scikit-learn is not installed")
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, rng.integers(1, 12), 200) / 8 - 0.5
    correct = rng.random(200) < 0.2 + 0.6 * (scores - scores.min())
    correct[:2] = [True, False]
    right = int(correct.sum())
    curve = curve_of(scores, correct, right, start=1.0)
    precision, recall, thresholds = sklearn.precision_recall_curve(correct, scores)
    np.testing.assert_allclose(curve.precision, precision[-2::-1], rtol=1e-12)
    np.testing.assert_allclose(curve.recall, recall[-2::-1], rtol=1e-12)
    np.testing.assert_array_equal(curve.thresholds, thresholds[::-1])
    assert curve.auc == pytest.approx(sklearn.auc(recall, precision), abs=1e-12)
    expected = sklearn.average_precision_score(correct, scores)
    assert curve.average_precision == pytest.approx(expected, abs=1e-12)
    found = roc_auc(curve, np.array(float(right)), np.array(200.0 - right))
    assert found == pytest.approx(sklearn.roc_auc_score(correct, scores), abs=1e-12)


def test_wilson_is_that_of_scipy():
    right, accepted = np.array([(r, n) for n in (1, 10, 73, 400) for r in (0, n // 2, n)], float).T
    expected = [
        binomtest(int(r), int(n)).proportion_ci(0.95, "wilson").low
        for r, n in zip(right, accepted, strict=True)
    ]
    np.testing.assert_allclose(wilson_low(right, accepted), expected, atol=1e-12)
    assert wilson_low(np.zeros(1), np.zeros(1)) == 0


def test_the_suggestion_lies_between_scores():
    """Before the first score that would spoil it, of few decimals; 0.5 and 0.25 are both wrong."""
    scores = [*[0.75] * 100, *[0.5] * 50, *[0.25] * 50]
    point = suggested_point(curve_of(scores, [1] * 100 + [0] * 100, 100))
    assert (point.threshold, point.accepted, point.recall) == (0.62, 100, 1.0)
    assert point.precision_low > 0.95


def test_match_accepts_at_the_suggested_threshold():
    """Above it, in float32, also where all scores that were measured are accepted."""
    references = torch.eye(2)
    queries = torch.tensor([[0.6, 0.8]]).repeat(100, 1)
    scores = match(queries, references, top=1).scores[:, 0].numpy()
    point = suggested_point(curve_of(scores, [1] * 100, 100))
    assert point.threshold < scores.min()
    assert bool((match(queries, references, 1, point.threshold).indices >= 0).all())


SOME_SCORE = st.sampled_from([-0.25, 0.0, 0.25, 0.5, 1.0])


@given(st.lists(st.tuples(SOME_SCORE, st.booleans()), min_size=1, max_size=30), st.floats(0.01, 1))
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
        assert (point and point.threshold) == expected
        if point:
            assert point.accepted == counts[expected][1]
            assert point.precision == pytest.approx(counts[expected][0] / counts[expected][1])
    point = suggested_point(curve, fraction)
    low = {t: float(wilson_low(np.array(r), np.array(n))) for t, (r, n) in counts.items()}
    sure = [t for t in low if low[t] >= min(fraction, max(low.values()))]
    assert (point is None) == (not correct.any())
    if point:
        assert (
            (scores >= point.threshold).sum() == (scores > point.threshold).sum() == point.accepted
        )
        assert point.accepted == counts[min(sure)][1]


def with_heavy_ties(queries, seed=0):
    """Candidates with heavy ties, some queries without a true match."""
    rng = np.random.default_rng(seed)
    scores = -np.sort(-rng.integers(0, 20, (queries, 5)) / 20, axis=1)
    indices = rng.integers(0, 30, (queries, 5))
    truth = [rng.choice(30, rng.integers(0, 9), replace=False) for _ in range(queries)]
    return scores, indices, truth


def flat(figures):
    rates = figures["recall_at"].values()
    return [*rates, *(figures[name] for name in FIGURES)]


@pytest.mark.parametrize("convention", ["exact", "vpr-bench"])
@pytest.mark.parametrize("cells", [1 << 22, 90])
def test_equals_resamples_evaluated_one_by_one(convention, cells, monkeypatch):
    """Of 47 queries in circular blocks of 4, however many resamples are computed at once."""
    monkeypatch.setattr(bootstrapping, "_CELLS", cells)
    scores, indices, truth = with_heavy_ties(47)
    rng = np.random.default_rng(7)
    figures = []
    for _ in range(60):
        begins = rng.integers(0, 47, 12)
        chosen = [(begin + step) % 47 for begin in begins for step in range(4)][:47]
        again = [truth[query] for query in chosen]
        figures.append(flat(evaluate(scores[chosen], indices[chosen], again, (1, 5), convention)))
    expected = np.nanpercentile(figures, (2.5, 97.5), axis=0).T
    found = evaluate(scores, indices, truth, (1, 5), convention, resamples=60, seed=7)
    np.testing.assert_allclose(flat(found["intervals"]), expected, rtol=1e-12)


@pytest.mark.parametrize(("queries", "alone"), [(7, 7), (90, 10), (400, 40)])
def test_fractions_that_all_resamples_agree_on_have_the_interval_of_wilson(queries, alone):
    """By the rule of three, as many independent queries as there are blocks show that little."""
    scores, truth = np.ones((queries, 1)), [np.array([0])] * queries
    for row, convention in product((0, 1), ("exact", "vpr-bench")):
        found = evaluate(scores, np.full((queries, 1), row), truth, (1,), convention, resamples=20)
        ends, z2 = found["intervals"], 1.959964**2
        expected = (alone / (alone + z2), 1) if row == 0 else (0, z2 / (alone + z2))
        np.testing.assert_allclose(ends["recall_at"]["1"], expected, rtol=1e-6)
        if row == 0:
            np.testing.assert_allclose(ends["recall_at_100_precision"], expected, rtol=1e-6)
            assert ends["auc_pr"] == [1.0, 1.0]
