"""The settings of the loop detector: what is allowed, and what a wrong one is told."""

import dataclasses
import math

import pytest

from ssrvlad_torch.loops.config import LoopConfig


def test_settings_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        LoopConfig().exclude = 3


def test_whole_numbers_do_for_numbers():
    assert LoopConfig(threshold=3, ratio=1, exclude_seconds=2) == LoopConfig(
        threshold=3.0, ratio=1.0, exclude_seconds=2.0
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"exclude": -1}, "exclude must be an integer from 0 to 2147483648, got -1"),
        ({"exclude": 2.0}, "exclude must be an integer"),
        ({"temporal": 101}, "temporal must be an integer from 0 to 100, got 101"),
        ({"relative": True}, "relative must be an integer from 0 to 10000, got True"),
        ({"neighbourhood": -1}, "neighbourhood must be an integer"),
        ({"confirmations": 0}, "confirmations must be an integer from 1 to 1000, got 0"),
        ({"window": "3"}, "window must be an integer from 0 to 10000, got '3'"),
        (
            {"exclude_seconds": -0.1},
            "exclude_seconds must be a finite number from 0 to inf, got -0.1",
        ),
        ({"exclude_seconds": math.inf}, "exclude_seconds must be a finite"),
        ({"threshold": math.nan}, "threshold must be a finite number from -10 to 1000, got nan"),
        ({"ratio": 1.1}, "ratio must be a finite number from 0 to 1, got 1.1"),
        ({"ratio": None}, "ratio must be a finite number from 0 to 1, got None"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        LoopConfig(**settings)
