"""Signs, compared in packed bits, against plain matrices of 1 and -1."""

import torch
from helpers import grids
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.channels.signs import moved

SHAPE = (8, 3, 4)


@given(st.integers(-3, 3))
def test_moved_columns_leave_zeros(columns):
    grid = grids(2, SHAPE)
    after = moved(grid, columns)
    for column in range(SHAPE[0]):
        source = column - columns
        inside = 0 <= source < SHAPE[0]
        expected = grid[:, source] if inside else torch.zeros_like(grid[:, 0])
        assert torch.equal(after[:, column], expected)
