"""Intervals against resamples that are evaluated one by one."""

import math

import numpy as np
import pytest

from ssrvlad_torch.evaluation import bootstrap as module
from ssrvlad_torch.evaluation.bootstrap import bootstrap
from ssrvlad_torch.evaluation.metrics import FIGURES, evaluate


def results(queries, seed=0):
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
@pytest.mark.parametrize("block", [1 << 22, 90])
def test_equals_resamples_evaluated_one_by_one(convention, block, monkeypatch):
    """Whatever the number of resamples that are computed at once."""
    monkeypatch.setattr(module, "_CELLS", block)
    scores, indices, truth = results(40)
    rng = np.random.default_rng(7)
    figures = []
    for _ in range(60):
        chosen = rng.integers(0, 40, 40)
        again = [truth[query] for query in chosen]
        figures.append(flat(evaluate(scores[chosen], indices[chosen], again, (1, 5), convention)))
    expected = np.percentile(figures, (2.5, 97.5), axis=0).T
    found = evaluate(scores, indices, truth, (1, 5), convention, resamples=60, seed=7)
    np.testing.assert_allclose(flat(found["intervals"]), expected, rtol=1e-12)


def test_a_seed_gives_the_same_draw():
    first, again, other = (
        evaluate(*results(50), at=(1,), resamples=30, seed=seed)["intervals"] for seed in (1, 1, 2)
    )
    assert first == again != other


def test_the_interval_of_a_mean_is_that_of_the_normal_approximation():
    values = np.random.default_rng(0).random(400) < 0.3
    found = bootstrap(lambda w: {"fraction": w @ values / w.sum(axis=1)}, 400, 4000)["fraction"]
    spread = 1.96 * values.std() / 20
    np.testing.assert_allclose(found, (values.mean() - spread, values.mean() + spread), atol=0.004)


def test_resamples_without_a_figure_are_passed_over():
    """One query in three has a true match; a resample without it has no recall."""
    scores, indices = np.ones((3, 1)), np.zeros((3, 1), np.int64)
    truth = [np.array([0]), np.array([], np.int64), np.array([], np.int64)]
    intervals = evaluate(scores, indices, truth, (1,), resamples=200)["intervals"]
    assert intervals["recall_at"]["1"] == [1.0, 1.0]
    assert 0 < intervals["auc_pr"][0] < intervals["auc_pr"][1] <= 1
    none = bootstrap(lambda w: {"x": np.full(len(w), np.nan)}, 0, 10)["x"]
    assert all(map(math.isnan, none)), "of no queries"
