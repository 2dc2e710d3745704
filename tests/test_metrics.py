"""Metrics against tables worked by hand and against what VPR-Bench prints."""

import math

import numpy as np
import pytest
import torch
from test_outcomes import rows
from vpr_bench import frozen_corridor, needs_vpr_bench, stored_results

from ssrvlad_torch import match
from ssrvlad_torch.evaluation.metrics import CONVENTIONS, evaluate, precision_recall_curve
from ssrvlad_torch.evaluation.outcomes import judge

INF = math.inf


def recall_rate(indices, truth, n):
    scores = np.where(indices < 0, -INF, 0.5)
    return evaluate(scores, indices, truth, at=(n,))["recall_at"][str(n)]


@pytest.mark.parametrize(("n", "expected"), [(1, 1 / 3), (2, 2 / 3), (3, 2 / 3), (4, 3 / 3)])
def test_the_recall_rate_of_four_queries_equals_that_by_hand(n, expected):
    """The first true match of the queries stands at place 1, 2 and 4; the last query has none."""
    indices = np.array([[5, 1, 2, 3], [1, 6, 2, 3], [9, 8, 0, 7], [0, 1, 2, 3]])
    truth = rows([5], [6, 100], [7], [])
    assert recall_rate(indices, truth, n) == pytest.approx(expected)


def test_recall_rate_without_candidates_true_matches_or_queries():
    assert recall_rate(np.array([[-1, -1], [0, -1]]), rows([3], [0]), 2) == 0.5
    assert math.isnan(recall_rate(np.array([[1], [2]]), rows([], []), 1))
    assert math.isnan(recall_rate(np.zeros((0, 5), np.int64), [], 1))


def test_the_metrics_of_five_queries_equal_those_by_hand():
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


def test_evaluate_takes_what_match_gives():
    scores, indices = match(torch.eye(12)[:3], torch.eye(12), top=10)
    truth = rows([0], [1], [5])
    arrays = evaluate(scores.numpy(), indices.numpy(), truth)
    assert evaluate(scores, indices, truth) == arrays
    similarity, pairs = torch.eye(12)[:3], {"convention": "vpr-tutorial"}
    of_tensors = evaluate(scores, indices, truth, similarity=similarity, **pairs)
    of_arrays = evaluate(scores, indices, truth, similarity=similarity.numpy(), **pairs)
    np.testing.assert_equal(of_tensors, of_arrays)


def test_evaluate_refuses_what_it_cannot_compute():
    scores, indices, truth = np.ones((2, 10)), np.zeros((2, 10), np.int64), rows([0], [1])
    with pytest.raises(ValueError, match=r"convention must be one of .*, got 'sklearn'"):
        evaluate(scores, indices, truth, convention="sklearn")
    with pytest.raises(ValueError, match="convention vpr-tutorial requires the similarity"):
        evaluate(scores, indices, truth, convention="vpr-tutorial")
    with pytest.raises(ValueError, match=r"similarity matrix for 2 queries, got \(3, 4\)"):
        evaluate(scores, indices, truth, convention="vpr-tutorial", similarity=np.ones((3, 4)))
    with pytest.raises(ValueError, match="1 of 2 queries have scores of candidates that are NaN"):
        evaluate(np.array([[math.nan], [1]]), indices[:, :1], truth, at=(1,))
    for n in (5, 0):
        with pytest.raises(ValueError, match=f"RecallRate@{n}: expected N from 1 to 4 candidates"):
            evaluate(scores[:, :4], indices[:, :4], truth, at=(1, n))


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
    curve = precision_recall_curve(outcomes, HANDMADE["truth"], convention)
    assert curve.precision.tolist() == [0, 1 / 2, 2 / 3, 2 / 4]
    assert curve.recall.tolist() == [0, step, 2 * step, 2 * step]


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("resamples", [0, 20])
def test_every_convention_takes_degenerate_results(convention, resamples):
    """No queries, no positives, no candidates, and scores that are all equal."""
    cases = [
        (np.zeros((0, 1)), np.zeros((0, 1), np.int64), rows(), np.zeros((0, 3))),
        (np.ones((2, 1)), np.zeros((2, 1), np.int64), rows([], []), np.ones((2, 3))),
        (np.full((2, 1), -INF), np.full((2, 1), -1), rows([0], [1]), np.full((2, 3), -INF)),
        (np.ones((2, 1)), np.zeros((2, 1), np.int64), rows([0], [1]), np.ones((2, 3))),
    ]
    results = [
        evaluate(*case[:3], (1,), convention, case[3], resamples=resamples) for case in cases
    ]
    assert math.isnan(results[0]["auc_pr"])
    assert math.isnan(results[1]["auc_pr"])
    assert results[3]["recall_at"] == {"1": 1 / 2}
    for result in results:
        assert ("intervals" in result) == bool(resamples)
    no_candidate = math.nan if convention == "vpr-bench" else 0.0
    assert results[2]["auc_pr"] == pytest.approx(no_candidate, nan_ok=True)
    equal = {"exact": 1 / 4, "vpr-bench": 3 / 4, "vpr-tutorial": 2 / 3}
    expected = equal.get(convention, (1 + 1 / 2) / 2 * (1 / 2))
    assert results[3]["auc_pr"] == pytest.approx(expected)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_curve_is_the_one_that_is_summed_up(convention):
    similarity = np.random.default_rng(0).random((4, 9))
    outcomes = judge(HANDMADE["scores"], HANDMADE["indices"], HANDMADE["truth"])
    curve = precision_recall_curve(outcomes, HANDMADE["truth"], convention, similarity)
    metrics = evaluate(**HANDMADE, at=(1,), convention=convention, similarity=similarity)
    assert curve.precision.shape == curve.recall.shape == curve.thresholds.shape
    assert curve.auc == metrics["auc_pr"]
    for name in ("average_precision", "extended_precision", "roc_auc"):
        assert math.isnan(metrics[name]) == convention.startswith("vpr-tutorial")
