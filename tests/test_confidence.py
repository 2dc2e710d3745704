import math

import numpy as np
import pytest
import torch
from core import chance_of, of_chances

from ssrvlad_torch.native.headers import model
from ssrvlad_torch.recognition.recognise import recognise_by_scores
from ssrvlad_torch.search.answers import accept, answered, estimate


def drawn_chances(queries: int, right: float, seed: int = 0, ahead: float = 6.0):
    """The chances of right and of wrong answers, and the truth: wrong ones are uniform."""
    random = np.random.default_rng(seed)
    is_right = random.random(queries) < right
    logs = np.where(is_right, random.gamma(2, ahead / 2, queries), random.exponential(1, queries))
    return torch.from_numpy(np.exp(-logs)), is_right


@pytest.mark.parametrize("right", [0.2, 0.6, 0.95])
def test_confidence_learns_how_often_answers_are_right(right):
    chances, truth = drawn_chances(4000, right)
    sure = of_chances(chances, 1.0)
    for half in (sure.right >= 0.5, sure.right < 0.5):
        assert abs(float(sure.right[half].mean()) - truth[half.numpy()].mean()) < 0.1
    assert abs(float(sure.right.mean()) - truth.mean()) < 0.1


def test_answers_are_less_sure_where_those_around_look_wrong():
    """The map has the places of the first half only; one answer of the other half stands out."""
    random = np.random.default_rng(1)
    mapped, unmapped = random.gamma(2, 3, 60), random.exponential(1, 60)
    unmapped[30] = 5
    here = of_chances(torch.from_numpy(np.exp(-np.r_[mapped, unmapped])), 1.0)
    assert here.right[:50].mean() > 0.9 and here.right[70:].mean() < 0.1
    mixed = np.r_[mapped, unmapped][order := random.permutation(120)]
    there = of_chances(torch.from_numpy(np.exp(-mixed)), 1.0)
    assert here.right[90] < 0.5 < there.right[(order == 90).nonzero()[0]]


@pytest.mark.parametrize("max_wrong", [0.02, 0.1, 0.5])
def test_accepts_as_many_as_the_estimate_permits(max_wrong):
    sure = of_chances(drawn_chances(300, 0.6)[0], 1.0)
    estimated = accept(sure, max_wrong)
    others = [estimate(sure, float(least)) for least in sure.right.unique()]
    assert estimated.accepted == max(one.accepted for one in others if one.wrong <= max_wrong)
    assert estimated in others and estimated.low <= estimated.wrong <= estimated.high


@pytest.mark.parametrize("level", [None, 0.2, 0.05])
def test_the_interval_holds(level):
    """For thresholds that are chosen by the same queries, too."""
    inside = []
    for seed in range(60):
        chances, truth = drawn_chances(200, (0.3, 0.6, 0.9)[seed % 3], seed)
        sure = of_chances(chances, 1.0)
        estimated = estimate(sure) if level is None else accept(sure, level)
        if estimated.accepted and estimated.low is not None:
            wrong = 1 - truth[(sure.right >= estimated.confidence).numpy()].mean()
            inside.append(estimated.low <= wrong <= estimated.high)
    assert len(inside) > 40 and np.mean(inside) > 0.9


def test_nothing_is_accepted_by_chance():
    sure = [of_chances(drawn_chances(200, 0.0, seed)[0], 1.0) for seed in range(50)]
    assert sum(accept(drawn, 0.05).accepted > 0 for drawn in sure) <= 2
    assert np.mean([estimate(drawn).wrong for drawn in sure]) > 0.95


def test_a_picture_is_judged_by_the_prior():
    clear, unclear = (of_chances(torch.tensor([chance]), 1.0) for chance in (1e-8, 0.3))
    assert clear.right > 0.95 and unclear.right < 0.5
    assert accept(clear, 0.05).accepted == 1 and accept(unclear, 0.05).accepted == 0
    estimated = estimate(unclear)
    assert (estimated.accepted, estimated.low, estimated.high) == (1, None, None)
    assert accept(unclear, 0.001) == estimate(unclear, 2.0) == (math.inf, 0, 0, 0, 0)


def test_what_has_a_candidate_is_an_answer():
    """Also in a map of too few references, where its confidence is 0."""
    for rows in (5, 40):
        scores = torch.from_numpy(np.random.default_rng(rows).random((40, rows)))
        scores[3] = -torch.inf
        sure = recognise_by_scores(scores, ["a"] * 40, ["b"] * rows).sure
        assert answered(sure).tolist() == [query != 3 for query in range(40)]
        assert sure.right.any() == (rows >= 30)
        assert estimate(sure).accepted == 39


def test_answers_that_err_together_widen_the_interval():
    chances, _ = drawn_chances(300, 0.6)
    one = of_chances(chances, 1.0)
    many = estimate(one._replace(together=torch.full((300,), 5.0)))
    one = estimate(one)
    assert one.wrong == many.wrong and many.low < one.low and many.high > one.high


# ---- rivals


ELSEWHERE = int(model("Place")["elsewhere"])


def chance_maps(rows: int, smooth: int, count: int = 4000) -> np.ndarray:
    """The chances of the best of rows that are all chance, each like those around it."""
    generator = torch.Generator().manual_seed(0)
    kernel = torch.hann_window(smooth + 2, periodic=False)[None, None, 1:-1]
    noise = torch.randn(count, 1, rows + smooth - 1, generator=generator)
    return np.array([chance_of(values).chance for values in torch.conv1d(noise, kernel)[:, 0]])


@pytest.mark.parametrize("smooth", [1, 7])
@pytest.mark.parametrize("rows", [60, 150, 1000])
def test_the_chance_of_a_wrong_answer_is_uniform(rows, smooth):
    """Whatever the size of the map, and however like one another its frames are."""
    chances = chance_maps(rows, smooth)
    for bound, most in ((0.5, 0.60), (0.1, 0.135), (0.01, 0.0165)):
        assert (chances < bound).mean() < most
    assert (chances < 0.5).mean() > 0.4 and (chances < 0.1).mean() > 0.06


@pytest.mark.parametrize("ahead", [4.0, 6.0])
def test_a_right_answer_is_hardly_chance(ahead):
    generator = torch.Generator().manual_seed(1)
    rows = torch.randn(500, 150, generator=generator)
    rows[:, 70] = ahead
    chances = np.array([chance_of(values).chance for values in rows])
    assert np.median(chances) < (0.1 if ahead < 5 else 0.01)


def test_places_are_peaks_that_are_apart():
    values = torch.zeros(60)
    values[[10, 11, 12, 40]] = torch.tensor([3.0, 5, 4, 2])
    assert chance_of(values).rival == 40
    values[11 + ELSEWHERE] = 2.5
    assert chance_of(values).rival == 40
    values[12 + ELSEWHERE] = 2.5
    assert chance_of(values).rival == 12 + ELSEWHERE
    rows = torch.tensor([3, 10, 11, 30])
    assert chance_of(torch.tensor([1.0, 5, 4, 2]), rows).rival == 30


def test_the_chance_of_some_rows_is_that_of_all():
    values = torch.randn(300, generator=torch.Generator().manual_seed(3))
    rows = values.topk(100).indices.sort().values
    assert chance_of(values[rows], rows, 300) == chance_of(values)
