from functools import cache

import numpy as np
import pytest
import torch
from drawings import CROSS, mask, planes
from graphs import run, run_on_planes, to_line
from hypothesis import given
from hypothesis import strategies as st
from test_bitplanes import random_planes

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.bitplanes import points, unpack
from ssrvlad_torch.deployment.stages.shape_context import (
    log_polar_bins_in_graph,
    shape_contexts_in_graph,
)
from ssrvlad_torch.deployment.words import grid_of, points_of
from ssrvlad_torch.stages import shape_context
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts

CPU = torch.device("cpu")


def plain_sum(references: np.ndarray, context: np.ndarray, limits, sectors) -> np.ndarray:
    total = np.zeros((len(limits), sectors), np.int64)
    for point in np.argwhere(references):
        total += reference.shape_context(point, np.argwhere(context), limits, sectors)
    return total.ravel()


@cache
def table_of(sectors):
    def build(graph, height, width, *limits):
        one = graph.full([], 1, "int32")
        listed = graph.Concat(*(limit.reshape(1) for limit in limits), axis=0)
        grid = grid_of(one, height, width)
        bins = log_polar_bins_in_graph(graph, grid, listed, len(limits), sectors)
        return [bins.table, bins.pitch, bins.centre]

    return build


@pytest.mark.parametrize("sectors", [1, 2, 3, 5, 8, 12, 20, 359, 360])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (31, 40), (150, 200)])
def test_the_table_in_a_graph_is_the_same(size, sectors):
    for rings in (1, 5):
        limits = SSRVLADConfig.from_preset(
            "paper", sectors=sectors, rings=rings, radius=0.6
        ).ring_limits(*size)
        expected = log_polar_bins(*size, limits, sectors, CPU).table
        table, pitch, centre = run(table_of(sectors), *size, *limits)
        assert pitch == expected.shape[0]
        rows = table.view(-1, pitch).T[:, : expected.shape[1]]
        assert torch.equal(rows, expected.long())
        assert table[centre] == len(limits) * sectors


@cache
def sums_with(sectors):
    def build(graph, words, some, *limits):
        grid = words.grid
        listed = graph.Concat(*(limit.reshape(1) for limit in limits), axis=0)
        bins = log_polar_bins_in_graph(graph, grid, listed, len(limits), sectors)
        references, context = points_of(graph, words.with_line(some)), points_of(graph, words)
        return [shape_contexts_in_graph(graph, references, context, bins, grid.images)]

    return build


@pytest.mark.parametrize("sectors", [1, 2, 3, 5, 8, 12, 20, 360])
def test_every_offset_falls_where_the_reference_puts_it(sectors):
    height, width = 31, 40
    limits = SSRVLADConfig.from_preset("paper", sectors=sectors, radius=0.6).ring_limits(
        height, width
    )
    bins = log_polar_bins(height, width, limits, sectors, CPU)
    y, x = np.indices((2 * height - 1, 2 * width - 1)).reshape(2, -1)
    for entry, offset in zip(
        bins.table.flatten().tolist(), np.stack((y - height + 1, x - width + 1), 1), strict=True
    ):
        histogram = reference.shape_context((0, 0), offset[None], limits, sectors).ravel()
        assert histogram.sum() == (entry < bins.total)
        assert entry == bins.total or histogram[entry] == 1


def sums_in_graph(references, context, limits, sectors=12):
    (sums,) = run_on_planes(sums_with(sectors), context, to_line(references), *limits)
    return sums


@given(
    seed=st.integers(0, 10_000),
    height=st.integers(1, 16),
    width=st.integers(1, 16),
    sectors=st.sampled_from([12, 5, 8]),
)
def test_sums_equal_the_reference(seed, height, width, sectors):
    context = random_planes(seed, (2, height, width)) & random_planes(seed + 1, (2, height, width))
    references = context & random_planes(seed + 2, (2, height, width))
    limits = SSRVLADConfig.from_preset("paper", radius=0.7).ring_limits(height, width)
    bins = log_polar_bins(height, width, limits, sectors, CPU)
    sums = shape_contexts(points(references), points(context), bins, 2)
    assert sums.shape == (2, 8, 5 * sectors)
    for b in range(2):
        for k in range(8):
            expected = plain_sum(
                unpack(references)[b, k].numpy(), unpack(context)[b, k].numpy(), limits, sectors
            )
            np.testing.assert_array_equal(sums[b, k], expected)
    assert torch.equal(sums_in_graph(references, context, limits, sectors), sums)


def test_chunks_add_up(monkeypatch):
    some = random_planes(11, (2, 20, 20))
    bins = log_polar_bins(20, 20, (4, 40, 400), 12, CPU)
    whole = shape_contexts(points(some), points(some), bins, 2)
    for chunk in (1000, 997, 4096):
        monkeypatch.setattr(shape_context, "PAIRS_AT_ONCE", chunk)
        assert torch.equal(shape_contexts(points(some), points(some), bins, 2), whole)


def test_blocks_in_a_graph_add_up():
    """More pairs than a block may have, and a layer and an image without any."""
    some = random_planes(12, (3, 60, 70)) & 0b01011111
    some[1] = 0
    bins = log_polar_bins(60, 70, (4, 40, 9000), 12, CPU)
    ends = some & random_planes(13, (3, 60, 70))
    expected = shape_contexts(points(ends), points(some), bins, 3)
    assert len(points(ends).group) * 400 > 4 * shape_context.PAIRS_AT_ONCE
    assert torch.equal(sums_in_graph(ends, some, (4, 40, 9000)), expected)


def test_nothing_to_count():
    none = points(torch.zeros(1, 5, 5, dtype=torch.uint8))
    cross = points(planes(mask(CROSS)[1:6, 1:6]))
    bins = log_polar_bins(5, 5, (50,), 12, CPU)
    assert not shape_contexts(none, cross, bins, 1).any()
    assert not shape_contexts(cross, none, bins, 1).any()
    assert not shape_contexts(none, none, bins, 1).any()
    nothing, some = torch.zeros(1, 5, 5, dtype=torch.uint8), planes(mask(CROSS)[1:6, 1:6])
    for references, context in ((nothing, some), (some, nothing), (nothing, nothing)):
        sums = sums_in_graph(references, context, (50,))
        assert sums.shape == (1, 8, 12)
        assert not sums.any()
