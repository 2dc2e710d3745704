import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.stages.reduction import cells, reduce_by_majority

CPU = torch.device("cpu")


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    rows=st.floats(0, 1),
    columns=st.floats(0, 1),
    kinds=st.integers(1, 9),
    seed=st.integers(0, 1000),
)
def test_equals_the_reference(height, width, rows, columns, kinds, seed):
    grid = (1 + int(rows * (height - 1)), 1 + int(columns * (width - 1)))
    maps = np.random.default_rng(seed).integers(0, kinds, (2, height, width), np.int32)
    reduced = reduce_by_majority(torch.from_numpy(maps), grid)
    assert reduced.dtype == torch.uint8
    for layers, image in zip(reduced, maps, strict=True):
        np.testing.assert_array_equal(layers, reference.reduce_by_majority(image, grid))


@pytest.mark.parametrize(("rows", "winner"), [(151, 7), (150, 8)])
def test_the_majority_of_a_large_cell_counts_every_pixel(rows, winner):
    layers = torch.full((1, 301, 299), 8, dtype=torch.int32)
    layers[0, :rows] = 7
    assert reduce_by_majority(layers, (1, 1)).item() == winner


@given(st.integers(1, 400), st.floats(0, 1))
def test_the_cell_of_a_pixel_is_the_quotient_rounded_down(pixels, share):
    count = 1 + int(share * (pixels - 1))
    assert torch.equal(cells(pixels, count, CPU), torch.arange(pixels) * count // pixels)
