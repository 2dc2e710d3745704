"""`recognition.motion`: beliefs move as each step says, and back by the transpose."""

import math

import pytest
import torch
from torch import Tensor

from ssrvlad_torch.recognition.motion import (
    BACKWARDS,
    CELLS,
    FORWARDS,
    SPEEDS,
    Motion,
    moments,
    moved,
    nearness,
    steps_of,
)

WAYS = (FORWARDS, BACKWARDS)
MOTION = Motion(change=0.1, jump=0.05)
GAP = MOTION.gap


def belief(cells: int, seed: int = 0) -> Tensor:
    shape = len(WAYS), len(SPEEDS), cells
    drawn = torch.rand(shape, generator=torch.Generator().manual_seed(seed))
    drawn[:, :, :GAP] = drawn[:, :, -GAP:] = 0
    return drawn


def step_by_step(before: Tensor) -> Tensor:
    after = torch.zeros_like(before)
    for way, sign in enumerate(WAYS):
        for speed, (chance, steps) in enumerate(SPEEDS):
            kept = (1 - MOTION.change) * before[way, speed]
            turned = MOTION.change * chance * before[way].sum(0) + kept
            for step, part in steps.items():
                after[way, speed] += (1 - MOTION.jump) * part * turned.roll(sign * step)
    return after


@pytest.mark.parametrize("cells", [2 * GAP, 2 * GAP + 1, 40, CELLS + 2 * GAP, CELLS + 2 * GAP + 1])
def test_a_belief_moves_by_every_step(cells):
    before = belief(cells)
    inside = slice(GAP, cells - GAP)
    got = moved(before, MOTION, WAYS)
    torch.testing.assert_close(got[:, :, inside], step_by_step(before)[:, :, inside])
    assert not got[:, :, :GAP].any() and not got[:, :, cells - GAP :].any()


@pytest.mark.parametrize("cells", [30, CELLS + 30])
def test_back_is_the_transpose(cells):
    one, other = belief(cells), belief(cells, 1)
    there = (moved(one, MOTION, WAYS) * other).double().sum()
    back = (one * moved(other, MOTION, WAYS, back=True)).double().sum()
    torch.testing.assert_close(there, back, rtol=1e-6, atol=0)


@pytest.mark.parametrize("rate", [0.25, 1, 2.5, 3])
def test_steps_at_a_rate(rate):
    """They are as many times as long on average, and all are steps of the motion."""
    for speed, (_, steps) in enumerate(SPEEDS):
        at_rate = steps_of(speed, rate)
        assert sum(at_rate.values()) == pytest.approx(1)
        mean = sum(step * chance for step, chance in steps.items())
        assert sum(step * chance for step, chance in at_rate.items()) == pytest.approx(rate * mean)
        assert set(at_rate) <= set(Motion(rate=rate).steps)


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
