"""The curve over all pairs, against a plain loop over its thresholds."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from test_outcomes import rows

from ssrvlad_torch.evaluation.tutorial import STEPS, count_pairs

INF = math.inf


def lists(matrix):
    return [np.flatnonzero(row) for row in matrix]


def whole(counts):
    return counts.curve(np.ones(len(counts.positives)))


def plain_curve(similarity, hard, single):
    """Points from (recall 0, precision 1) on; every threshold looks at every pair anew."""
    positives = hard.sum()
    if single:
        positives = sum(any(row) for row in hard)
        best = [int(row.argmax()) for row in similarity]
        hard = np.array([[row[b]] for row, b in zip(hard, best, strict=True)])
        similarity = np.array([[row[b]] for row, b in zip(similarity, best, strict=True)])
    points = [(0.0, 1.0)]
    for threshold in np.linspace(similarity.max(), similarity.min(), 100):
        accepted = similarity >= threshold
        right = (accepted & hard).sum()
        points.append((right / positives, right / accepted.sum()))
    return np.array(points).T


@st.composite
def tables(draw):
    shape = draw(st.tuples(st.integers(1, 8), st.integers(1, 8)))
    values = st.sampled_from([-0.75, -0.5, 0.0, 0.125, 0.3, 0.30000001, 0.9])
    similarity = draw(hnp.arrays(np.float64, shape, elements=values))
    hard = draw(hnp.arrays(bool, shape))
    hard[0, draw(st.integers(0, shape[1] - 1))] = True
    return similarity, hard


@given(tables(), st.booleans())
def test_equals_a_plain_loop(table, single):
    similarity, hard = table
    recall, precision = plain_curve(similarity, hard, single)
    curve = whole(count_pairs(similarity, lists(hard), single))
    assert len(curve.thresholds) == STEPS == 100
    np.testing.assert_allclose(curve.precision, precision[1:], rtol=1e-12)
    np.testing.assert_allclose(curve.recall, recall[1:], rtol=1e-12)
    area = sum(np.diff(recall) * (precision[1:] + precision[:-1]) / 2)
    assert curve.auc == pytest.approx(area)
    assert curve.recall_at_full_precision == pytest.approx(recall[precision == 1].max())


def test_minus_infinity_is_the_least_similar_and_float32_stays():
    similarity = np.array([[0.9, -INF], [0.3, 0.1]])
    filled = np.array([[0.9, 0.1], [0.3, 0.1]])
    noise = np.random.default_rng(0).random((2, 3)).astype(np.float32)
    for single, (one, other) in product(
        (False, True), ((similarity, filled), (noise, noise.astype(float)))
    ):
        found, expected = (
            whole(count_pairs(matrix, rows([0], [1]), single)) for matrix in (one, other)
        )
        np.testing.assert_array_equal(found.precision, expected.precision)
        np.testing.assert_array_equal(found.thresholds, expected.thresholds)


def test_weights_are_copies_of_queries():
    """On the thresholds of all queries."""
    rng = np.random.default_rng(1)
    similarity, hard = rng.random((6, 9)), rng.random((6, 9)) < 0.3
    weights = np.array([2, 0, 1, 3, 0, 1])
    for single in (False, True):
        counts = count_pairs(similarity, lists(hard), single)
        copies = np.repeat(np.arange(6), weights)
        weighted = counts.curve(weights.astype(float))
        np.testing.assert_array_equal(weighted.accepted, counts.accepted[copies].sum(axis=0))
        np.testing.assert_array_equal(weighted.positives, counts.positives[copies].sum())


@pytest.mark.parametrize(
    ("similarity", "message"),
    [
        (np.ones((1, 3)), r"for 2 queries, got \(1, 3\)"),
        (np.ones(2), r"got \(2,\)"),
        (np.array([[1, math.nan], [1, 1]]), "1 of 2 queries have similarities .* NaN"),
    ],
)
def test_a_similarity_of_another_shape_or_nan_is_refused(similarity, message):
    with pytest.raises(ValueError, match=message):
        count_pairs(similarity, rows([0], [1]))
