import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.stages import reduction
from ssrvlad_torch.taxonomy import NO_LAYER

UNKNOWN = NO_LAYER + 1
ALL = torch.arange(UNKNOWN + 1, dtype=torch.uint8)
"""A table of all kinds: they are the entries."""


def reduce_by_majority(categories, grid, table=ALL):
    return reduction.reduce_by_majority(categories.long(), *reduction.ballots(table), grid)


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
    maps = np.random.default_rng(seed).integers(0, kinds, (2, height, width))
    reduced, unknown = reduce_by_majority(torch.from_numpy(maps), grid)
    assert reduced.dtype == torch.uint8
    assert unknown.tolist() == [0, 0]
    for got, categories in zip(reduced, maps, strict=True):
        np.testing.assert_array_equal(got, reference.reduce_by_majority(categories, grid))


def test_the_majority_of_a_large_cell_counts_every_pixel():
    """A cell has more pixels than a group, and some groups are smaller."""
    categories = torch.full((1, 301, 299), 8, dtype=torch.uint8)
    categories[0, :151] = 7
    assert reduce_by_majority(categories, (1, 1))[0].item() == 7
    categories[0, :150] = 7
    categories[0, 150:300] = 0
    assert reduce_by_majority(categories, (1, 1))[0].item() == 0


@pytest.mark.parametrize("grid", [(1, 1), (4, 5), (9, 7), (30, 40)])
@pytest.mark.parametrize("kinds", [[0, 3, NO_LAYER, UNKNOWN], [0, 3, 5, UNKNOWN]])
def test_unknown_ids_are_counted_and_vote_for_no_layer(grid, kinds):
    """Tables of few kinds need fewer votes."""
    table = torch.tensor(kinds, dtype=torch.uint8)
    maps = torch.from_numpy(np.random.default_rng(3).integers(0, 4, (3, 30, 40)))
    maps[1], maps[2] = maps[1].clamp_max(2), 3
    got, unknown = reduce_by_majority(maps, grid, table)
    known, none = reduce_by_majority(table[maps].clamp_max(NO_LAYER), grid)
    assert torch.equal(got, known)
    assert torch.equal(unknown, (maps == 3).sum((1, 2)))
    assert not none.any()


@given(st.integers(1, 400), st.floats(0, 1), st.integers(1, 9))
def test_every_pixel_is_in_one_group_of_its_cell(pixels, share, most):
    cells = 1 + int(share * (pixels - 1))
    side = reduction.grouped(pixels, cells, most, torch.device("cpu"))
    assert side.pixels.shape[2] <= most
    index = side.pixels.transpose(0, 1).flatten(1)
    owner = torch.arange(cells)[:, None].expand_as(index)
    inside = side.inside.bool().transpose(0, 1).flatten(1)
    assert torch.equal(index[inside], torch.arange(pixels))
    assert torch.equal(owner[inside], torch.arange(pixels) * cells // pixels)
    assert torch.equal(side.sizes, inside.sum(1))
