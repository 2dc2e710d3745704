"""Signs, compared in packed bits, against plain matrices of 1 and -1."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import grids
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.channels.signs import moved
from ssrvlad_torch.recognition.recognise import Steps, recognise, references_of

SHAPE = (8, 3, 4)


def drive(count, seed=0):
    """Signs of a drive, most of which all its frames share."""
    rng = np.random.default_rng(seed)
    same, noise = rng.integers(0, 256, SHAPE, np.uint8), rng.integers(0, 256, (count, *SHAPE))
    few = rng.integers(0, 256, (count, *SHAPE)) & rng.integers(0, 256, (count, *SHAPE))
    return torch.from_numpy(same ^ (noise & few).astype(np.uint8))


@given(st.integers(-3, 3))
def test_moved_columns_leave_zeros(columns):
    grid = grids(2, SHAPE)
    after = moved(grid, columns)
    for column in range(SHAPE[0]):
        source = column - columns
        inside = 0 <= source < SHAPE[0]
        expected = grid[:, source] if inside else torch.zeros_like(grid[:, 0])
        assert torch.equal(after[:, column], expected)


@pytest.mark.parametrize("follow", [None, "offline"])
def test_recognise_takes_signs(follow):
    frames = drive(60)
    seen = frames[10:50] ^ (grids(40, SHAPE, 5) & grids(40, SHAPE, 6) & grids(40, SHAPE, 7))
    numbers_only = F.normalize(torch.rand(60, 16), dim=1)
    names = ["q"] * 40, ["r"] * 60
    town = references_of({"ssr-vlad": numbers_only, "features": frames}, names[1], {"features": 6})
    queries = {"ssr-vlad": numbers_only[10:50], "features": seen}
    answers = recognise(queries, names[0], town, Steps(follow=follow))
    assert answers.matches.indices[:, 0].tolist() == list(range(10, 50))
    assert set(answers.used["weights"]["q"]) == {"ssr-vlad", "features"}
