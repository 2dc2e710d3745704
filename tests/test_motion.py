"""Steps of a motion at a rate, as the oracle takes them."""

import pytest
from oracles.filter import SPEEDS, steps_of


@pytest.mark.parametrize("rate", [0.25, 1, 2.5, 3])
def test_steps_at_a_rate(rate):
    """They are as many times as long on average."""
    for speed, (_, steps) in enumerate(SPEEDS):
        at_rate = steps_of(speed, rate)
        assert sum(at_rate.values()) == pytest.approx(1)
        mean = sum(step * chance for step, chance in steps.items())
        assert sum(step * chance for step, chance in at_rate.items()) == pytest.approx(rate * mean)
