import numpy as np
import pytest
import torch
from drawings import random_planes
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.stages import shape_context
from ssrvlad_torch.stages.bitplanes import points, unpack
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts

CPU = torch.device("cpu")


def plain_sum(references: np.ndarray, context: np.ndarray, limits, sectors) -> np.ndarray:
    total = np.zeros((len(limits), sectors), np.int64)
    for point in np.argwhere(references):
        total += reference.shape_context(point, np.argwhere(context), limits, sectors)
    return total.ravel()


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


@pytest.mark.parametrize("pairs", [1000, 997])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (13, 101)])
def test_chunks_count_what_one_list_counts(monkeypatch, size, pairs):
    pixels = random_planes(14, (2, *size))
    ends = points(pixels & random_planes(15, (2, *size)))
    bins = log_polar_bins(*size, (4, 40, 400), 12, CPU)
    whole = shape_contexts(ends, points(pixels), bins, 2)
    monkeypatch.setattr(shape_context, "PAIRS_AT_ONCE", pairs)
    assert torch.equal(shape_contexts(ends, points(pixels), bins, 2), whole)
