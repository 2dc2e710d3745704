"""Each stage as arithmetic against the stage on tensors."""

import numpy as np
import pytest
import torch
from graphs import run
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch.bitplanes import unpack
from ssrvlad_torch.deployment.arithmetic.boundaries import boundaries_in_graph
from ssrvlad_torch.deployment.arithmetic.grid_pooling import pool_in_graph
from ssrvlad_torch.deployment.arithmetic.layers import layers_in_graph, layers_of_categories
from ssrvlad_torch.deployment.arithmetic.reduction import (
    MAX_CELL_WIDTH,
    RADIX,
    side_of,
    votes_in_graph,
)
from ssrvlad_torch.deployment.arithmetic.vanishing_column import (
    MAX_WIDTH,
    vanishing_columns_in_graph,
)
from ssrvlad_torch.stages.boundaries import boundaries
from ssrvlad_torch.stages.grid_pooling import pool
from ssrvlad_torch.stages.layers import UNKNOWN, merge, split
from ssrvlad_torch.stages.reduction import reduce_by_majority
from ssrvlad_torch.stages.vanishing_column import OPEN_LAYERS, vanishing_columns
from ssrvlad_torch.taxonomy import NO_LAYER

seeds, sides = st.integers(0, 10_000), st.integers(1, 40)


def entries(seed, size, kinds):
    return np.random.default_rng(seed).integers(0, kinds, size).astype(np.uint8)


def votes_of(table):
    def build(graph, image, grid):
        _, height, width = graph.sizes(image, 3)
        rows = side_of(graph, height, grid[0], RADIX - 1)
        columns = side_of(graph, width, grid[1])
        votes = votes_in_graph(graph, image, table, rows, columns)
        found = layers_in_graph(graph, graph.Slice(votes, [0], [NO_LAYER + 1], [1]), rows, columns)
        return [votes, *found]

    return build


def layers_build(graph, categories):
    return layers_of_categories(graph, categories)


ALL = np.array([*range(NO_LAYER + 1), UNKNOWN], np.uint8)
"""The kinds are the entries: more than one number has digits for."""
FEW = np.array([0, 3, 5, UNKNOWN], np.uint8)
"""One number is enough, and no entry is free for the margin."""
builds = {len(table): votes_of(table) for table in (ALL, FEW)}


def votes(image, table, grid):
    return run(builds[len(table)], torch.from_numpy(image), torch.tensor(grid))


@given(seeds, sides, sides, st.floats(0, 1), st.floats(0, 1), st.sampled_from([ALL, FEW]))
def test_votes_are_counted_and_the_commonest_kind_wins(seed, height, width, rows, columns, table):
    grid = (1 + int(rows * (height - 1)), 1 + int(columns * (width - 1)))
    image = entries(seed, (2, height, width), len(table))
    counted, masks, number, is_open = votes(image, table, grid)
    of_rows, of_columns = (
        np.arange(side) * cells // side for side, cells in zip((height, width), grid, strict=True)
    )
    expected = np.zeros((2, *grid, UNKNOWN + 1), int)
    np.add.at(
        expected, (np.arange(2)[:, None, None], of_rows[:, None], of_columns, table[image]), 1
    )
    expected[..., NO_LAYER] += expected[..., UNKNOWN]
    kinds = [*range(NO_LAYER + 1), UNKNOWN]
    np.testing.assert_array_equal(
        counted, expected.reshape(2, -1, UNKNOWN + 1)[:, :, kinds].swapaxes(1, 2)
    )

    known = torch.from_numpy(np.minimum(table[image], NO_LAYER))
    reduced = reduce_by_majority(known, grid)
    planes = merge(split(reduced))
    assert torch.equal(masks.bool(), unpack(planes)[:, :6])
    assert torch.equal(is_open[:, 0].bool(), planes & OPEN_LAYERS != 0)
    assert torch.equal(number[:, 0], torch.where(planes == 0, 6.0, planes.float().log2()))
    for of_votes, got in zip((masks, number, is_open), run(layers_build, reduced), strict=True):
        assert torch.equal(of_votes, got)


@pytest.mark.parametrize("size", [(2000, 3), (9, MAX_CELL_WIDTH), (1200, MAX_CELL_WIDTH)])
@pytest.mark.parametrize("kind", range(len(ALL)))
def test_the_largest_cells_are_counted_exactly(size, kind):
    """All pixels of a kind, and all but one: the sums are as large as they get."""
    image = np.full((1, *size), kind, np.uint8)
    counts = np.zeros(len(ALL))
    counts[kind] = image.size
    counts[NO_LAYER] = image.size * (kind >= NO_LAYER)
    np.testing.assert_array_equal(votes(image, ALL, (1, 1))[0][0, :, 0], counts)


def boundaries_build(graph, number):
    return [boundaries_in_graph(graph, number)]


@given(seeds, sides, sides, st.integers(1, 7))
def test_boundaries(seed, height, width, kinds):
    number = torch.from_numpy(entries(seed, (2, 1, height, width), kinds))
    planes = torch.where(number < 6, 1 << number.int(), 0).to(torch.uint8)[:, 0]
    got = run(boundaries_build, number.float())[0]
    assert torch.equal(got.bool(), unpack(boundaries(planes))[:, :4])


def columns_build(graph, is_open):
    return [vanishing_columns_in_graph(graph, is_open)]


def columns(is_open):
    got = run(columns_build, torch.from_numpy(is_open[:, None]).float())[0]
    planes = torch.from_numpy(is_open).to(torch.uint8)
    assert torch.equal(got, vanishing_columns(planes).float())


@given(seeds, st.integers(1, 150), st.integers(1, 90), st.floats(0, 1))
def test_vanishing_column(seed, height, width, density):
    rng = np.random.default_rng(seed)
    columns(rng.random((2, height, width)) < density)
    columns(np.arange(height)[:, None] < rng.integers(0, height + 1, (2, 1, width)))


@pytest.mark.parametrize("width", [1, 2, 239, 240, MAX_WIDTH - 1, MAX_WIDTH])
def test_vanishing_columns_at_the_ends(width):
    """The largest sums: everything open, one half, and the last columns only."""
    for first in {0, width // 2, width - 1, width - width // 20}:
        is_open = np.zeros((2, 120, width), bool)
        is_open[0, :, first:] = True
        is_open[1, :, : width - first] = True
        columns(is_open)


def pool_build(graph, masks, shift):
    return [pool_in_graph(graph, masks, shift)]


@given(
    seeds,
    st.integers(1, 60),
    st.integers(1, 80),
    st.lists(st.integers(-90, 90), min_size=1, max_size=3),
)
def test_grid_pooling(seed, height, width, shift):
    planes = torch.from_numpy(entries(seed, (len(shift), height, width), 256))
    masks = unpack(planes)[:, :5].float()
    got = run(pool_build, masks, torch.tensor(shift).float())[0].double() / (height * width)
    assert torch.equal(got, pool(planes, torch.tensor(shift))[:, :5])
