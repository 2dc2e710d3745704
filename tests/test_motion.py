"""`recognition.motion`: steps at a rate, and the spread of scores."""

import math

import pytest
import torch

from ssrvlad_torch.recognition.motion import SPEEDS, Motion, moments, nearness, steps_of


@pytest.mark.parametrize("rate", [0.25, 1, 2.5, 3])
def test_steps_at_a_rate(rate):
    """They are as many times as long on average."""
    for speed, (_, steps) in enumerate(SPEEDS):
        at_rate = steps_of(speed, rate)
        assert sum(at_rate.values()) == pytest.approx(1)
        mean = sum(step * chance for step, chance in steps.items())
        assert sum(step * chance for step, chance in at_rate.items()) == pytest.approx(rate * mean)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"jump": 1.5}, "jump: expected a probability from 0 to 1, got 1.5"),
        ({"weight": 0}, "expected a finite weight above 0 and a finite level, got 0 and 0.5"),
        ({"rate": 0}, "rate: expected a number above 0, and at most 100, got 0"),
        ({"rate": 1e9}, "rate: expected a number above 0, and at most 100, got 1000000000.0"),
        ({"rate": math.nan}, "rate: expected a number above 0, and at most 100, got nan"),
    ],
)
def test_a_motion_out_of_range_is_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        Motion(**settings)


def test_moments_leave_out_what_has_no_score():
    scores = torch.rand(5000, generator=torch.Generator().manual_seed(0))
    near = nearness(scores).double()
    scores = torch.cat((scores, torch.full((9,), -torch.inf)))
    expected = float(near.mean()), float(near.std(correction=0))
    assert moments(scores) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("scores", [[], [0.3], [1.0] * 999, [-torch.inf] * 3, [0.1] * 5])
def test_scores_that_are_all_equal_have_no_spread(scores):
    assert moments(torch.tensor(scores))[1] <= 1e-6
