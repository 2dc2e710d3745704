"""The settings of the loop detector: what is allowed, and what a wrong one is told."""

import math

import numpy as np
import pytest

from ssrvlad_torch.loops.config import LoopConfig


def test_numbers_of_numpy_are_numbers():
    config = LoopConfig(exclude=np.int64(3), threshold=np.float32(0.5))
    assert config == LoopConfig(exclude=3, threshold=0.5) and type(config.exclude) is int


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exclude": -1}, "exclude: expected an integer from 0, got -1"),
        ({"exclude": 2.0}, "exclude: expected an integer"),
        ({"exclude": True}, "exclude: expected an integer"),
        ({"threshold": math.nan}, "threshold: expected a number from 0 to 1, got nan"),
        ({"threshold": 1.1}, "threshold: expected a number"),
        ({"threshold": None}, "threshold: expected a number"),
        ({"sweep": 1}, "sweep: expected a bool, got 1"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        LoopConfig(**settings)
