import math

import numpy as np
import pytest
import torch
from scipy.stats import nbinom

from ssrvlad_torch.recognition.confidence import (
    ALONE,
    Confidence,
    _quantile,
    accept,
    answers_together,
    estimate,
)


def traverse(queries: int, right: float, slope: float, seed: int = 0):
    """Leads of chance, to both sides alike, and of right answers, with the truth: right answers are
    ``exp(0.8 * slope * lead)`` times as likely."""
    random = np.random.default_rng(seed)
    is_right = random.random(queries) < right
    side = np.where(random.random(queries) < np.where(is_right, 0.9, 0.5), 1, -1)
    leads = side * random.exponential(1 / (slope * (1 - 0.8 * side * is_right)))
    return torch.tensor(leads, dtype=torch.float32), is_right


@pytest.mark.parametrize("slope", [1.0, 4.0])
@pytest.mark.parametrize("right", [0.2, 0.6, 0.95])
def test_confidence_learns_from_decoys_how_often_answers_are_right(right, slope):
    leads, truth = traverse(4000, right, slope)
    sure = Confidence.of_leads(leads, ALONE, 1.0)
    accepted = (sure.right >= 0.5).numpy()
    assert abs(sure.right[accepted].mean() - truth[accepted].mean()) < 0.1
    assert abs(sure.right.mean() - truth.mean()) < 0.12


def test_confidence_is_monotone_in_the_lead():
    leads = torch.linspace(-5, 5, 101)
    sure = Confidence.of_leads(leads, ALONE, 2.0)
    assert (sure.right.diff() > 0).all() and (sure.together == 2).all()
    assert torch.equal(sure.decoy > 0, leads < 0)
    torch.testing.assert_close(sure.decoy[:50], sure.right[51:].flip(0))
    places = Confidence.of_places(torch.linspace(0, 0.9, 9), torch.full((9,), 0.1), "online")
    assert (places.right.diff() > 0).all()


def test_a_query_without_a_candidate_is_neither_answer_nor_decoy():
    leads, _ = traverse(50, 0.5, 1.0)
    sure = Confidence.of_leads(leads, ALONE, 1.0)
    more = Confidence.of_leads(torch.cat((leads, torch.tensor([torch.nan]))), ALONE, 1.0)
    torch.testing.assert_close(more.right, torch.cat((sure.right, torch.zeros(1))))
    assert more.decoy[-1] == 0 and estimate(more).accepted == (leads > 0).sum()


@pytest.mark.parametrize("max_wrong", [0.02, 0.1, 0.5])
def test_accepts_as_many_as_the_estimate_permits(max_wrong):
    leads, _ = traverse(300, 0.6, 2.0)
    sure = Confidence.of_leads(leads, ALONE, 1.0)
    found = accept(sure, max_wrong)
    each = [estimate(sure, float(least)) for least in sure.right.unique()]
    most = max((one.accepted for one in each if one.wrong <= max_wrong), default=0)
    assert found.accepted == most and (found.wrong <= max_wrong) == (most > 0 or found.wrong == 0)
    if most:
        assert found in each and found.low <= found.wrong <= found.high


def test_the_interval_holds():
    """For thresholds that are chosen by the same queries, too."""
    inside = []
    for seed in range(200):
        leads, truth = traverse(200, 0.4, 1.0, seed)
        sure = Confidence.of_leads(leads, ALONE, 1.0)
        found = accept(sure, 0.2)
        if found.accepted:
            wrong = 1 - truth[(sure.right >= found.confidence).numpy()].mean()
            inside.append(found.low <= wrong <= found.high)
    assert len(inside) > 150 and np.mean(inside) > 0.9


def test_nothing_is_accepted_by_chance():
    accepted = [
        accept(Confidence.of_leads(traverse(200, 0.0, 1.0, seed)[0], ALONE, 1.0), 0.05).accepted
        for seed in range(50)
    ]
    assert np.count_nonzero(accepted) <= 3


def test_few_queries_are_estimated_by_their_doubts():
    sure = Confidence(torch.tensor([0.99, 0.9, 0.4, 0]), torch.zeros(4), torch.ones(4))
    found = estimate(sure, 0.5)
    assert found.accepted == 2 and found.wrong == pytest.approx((0.01 + 0.1) / 2)
    assert (found.low, found.high) == (0, 1)
    assert accept(sure, 0.06) == estimate(sure, float(sure.right[1]))
    assert accept(sure, 0.001) == estimate(sure, 2.0) == (math.inf, 0, 0, 0, 0)
    unknown = Confidence(torch.full((99,), 0.9), torch.full((99,), torch.nan), torch.ones(99))
    assert estimate(unknown).wrong == pytest.approx(0.1)


def test_answers_that_err_together_widen_the_interval():
    leads, _ = traverse(300, 0.6, 2.0)
    one, many = (
        estimate(Confidence.of_leads(leads, ALONE, 1.0)._replace(together=torch.full((300,), size)))
        for size in (1.0, 5.0)
    )
    assert one.wrong == many.wrong and many.low < one.low and many.high > one.high


def test_runs_of_one_answer():
    assert answers_together(torch.tensor([3, 40, 9, 80])) == 1
    assert answers_together(torch.tensor([3, 4, 6, 80, 20, 20])) == (9 + 1 + 4) / 6
    assert answers_together(torch.zeros(7)) == 7
    assert answers_together(torch.zeros(0)) == 1


@pytest.mark.parametrize("failures", [0.2, 1, 7.5, 300])
@pytest.mark.parametrize("probability", [0.025, 0.975])
def test_quantiles_are_those_of_scipy(failures, probability):
    assert _quantile(failures, probability) == nbinom.ppf(probability, failures, 0.5)
