import numpy as np
import pytest
import torch
from graphs import run
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import reference
from ssrvlad_torch.deployment.stages.reduction import reduce_by_majority_in_graph
from ssrvlad_torch.stages import reduction
from ssrvlad_torch.taxonomy import NO_LAYER

UNKNOWN = NO_LAYER + 1


def in_graph(graph, images, size):
    """The categories themselves are the entries of a table of all of them."""
    table = np.arange(UNKNOWN + 1, dtype=np.uint8)
    _, height, width = graph.sizes(images, 3)
    return reduce_by_majority_in_graph(graph, images, table, (height, width), (size[0], size[1]))


def reduce_by_majority(categories, grid):
    """In a pass over the batch and in a graph, which must agree; also at native size."""
    reduced = reduction.reduce_by_majority(categories, grid)
    got, unknown = run(in_graph, categories, torch.tensor(grid))
    assert torch.equal(got, reduced)
    assert unknown.tolist() == [0] * len(categories)
    return reduced


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
    reduced = reduce_by_majority(torch.from_numpy(maps).to(torch.uint8), grid)
    assert reduced.dtype == torch.uint8
    for got, categories in zip(reduced, maps, strict=True):
        np.testing.assert_array_equal(got, reference.reduce_by_majority(categories, grid))


def test_cells_of_many_pixels():
    """Counts above 127 need more bits a category than nine of them have in one word."""
    categories = torch.full((1, 300, 300), 8, dtype=torch.uint8)
    categories[0, :151] = 7
    assert reduce_by_majority(categories, (1, 1)).item() == 7
    categories[0, :150] = 7
    categories[0, 150:] = 0
    assert reduce_by_majority(categories, (1, 1)).item() == 0


def test_native_size_is_untouched():
    categories = torch.zeros(1, 5, 6, dtype=torch.uint8)
    assert reduction.reduce_by_majority(categories, (5, 6)) is categories
    assert torch.equal(reduce_by_majority(categories, (5, 6)), categories)


@pytest.mark.parametrize("grid", [(1, 1), (4, 5), (9, 7), (30, 40)])
def test_unknown_ids_are_counted_and_vote_for_no_layer(grid):
    kinds = [0, 3, NO_LAYER, UNKNOWN]
    maps = torch.from_numpy(np.random.default_rng(3).choice(kinds, (3, 30, 40)))
    maps[1], maps[2] = maps[1].clamp_max(NO_LAYER), UNKNOWN
    got, unknown = run(in_graph, maps.to(torch.uint8), torch.tensor(grid))
    known = maps.clamp_max(NO_LAYER).to(torch.uint8)
    assert torch.equal(got, reduction.reduce_by_majority(known, grid))
    assert torch.equal(unknown, (maps == UNKNOWN).sum((1, 2)))
