"""The record of each query."""

import math

import numpy as np
import pytest

from ssrvlad_torch.evaluation.outcomes import judge

INF = math.inf


def rows(*matches):
    return [np.array(match, np.int64) for match in matches]


def test_the_outcomes_of_five_queries_equal_those_by_hand():
    scores = np.array([[0.9, 0.8], [0.7, 0.1], [0.6, -INF], [-INF, -INF], [0.2, 0.1]], np.float32)
    indices = np.array([[4, 2], [3, 0], [1, -1], [-1, -1], [8, 9]])
    outcomes = judge(scores, indices, rows([4, 7], [0], [], [1], [5]))
    assert outcomes.score.dtype == np.float64
    np.testing.assert_allclose(outcomes.score, [0.9, 0.7, 0.6, -INF, 0.2], rtol=1e-6)
    assert outcomes.candidate.tolist() == [4, 3, 1, -1, 8]
    assert outcomes.correct.tolist() == [True, False, False, False, False]
    assert outcomes.has_match.tolist() == [True, True, False, True, True]
    assert outcomes.rank.tolist() == [1, 2, 0, 0, 0]
    assert len(outcomes) == 5
    none = judge(np.zeros((0, 3)), np.zeros((0, 3), np.int64), [])
    assert len(none) == len(none.rank) == 0


@pytest.mark.parametrize(
    ("scores", "indices", "message"),
    [
        (np.ones((2, 3)), np.zeros((2, 2), int), r"of one shape .*\(2, 3\) and \(2, 2\)"),
        (np.ones((2, 0)), np.zeros((2, 0), int), "top >= 1"),
        (np.ones((3, 1)), np.zeros((3, 1), int), "candidates for 2 queries"),
        (np.ones(2), np.zeros(2, int), r"for 2 queries, got \(2,\)"),
        (np.array([[1.0, 0], [1, math.nan]]), np.zeros((2, 2), int), "1 of 2 queries .* NaN"),
        (np.array([[INF], [math.nan]]), np.zeros((2, 1), int), "2 of 2 queries"),
        (np.array([[0.9], [0.9]]), np.array([[0], [-1]]), "a score but no row"),
    ],
)
def test_scores_and_truth_of_other_shapes_are_refused(scores, indices, message):
    with pytest.raises(ValueError, match=message):
        judge(scores, indices, rows([0], [0]))


@pytest.mark.parametrize(
    "truth", [np.eye(2, dtype=bool), np.eye(2, dtype=int), list(np.eye(2) > 0)]
)
def test_a_matrix_in_place_of_rows_is_refused(truth):
    with pytest.raises(ValueError, match=r"expected the rows .*got a matrix.*flatnonzero"):
        judge(np.ones((2, 1)), np.zeros((2, 1), int), truth)
