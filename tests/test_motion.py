"""`recognition.motion`: steps at a rate."""

import math

import pytest

from ssrvlad_torch.recognition.motion import SPEEDS, Motion, steps_of


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
