import numpy as np
import pytest
import torch
from drawings import random_planes
from hypothesis import given
from hypothesis import strategies as st

from ssrvlad_torch import SSRVLADConfig, reference
from ssrvlad_torch.stages import shape_context
from ssrvlad_torch.stages.bitplanes import points, unpack
from ssrvlad_torch.stages.shape_context import log_polar_bins

CPU = torch.device("cpu")


def shape_contexts(references, *others):
    (sums,) = shape_context.shape_contexts([references], *others)
    return sums


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


@pytest.mark.parametrize(
    ("setting", "value"),
    [*(("PAIRS_AT_ONCE", pairs) for pairs in (1000, 997, 4096)), ("MOST_PAIRS", 0)],
)
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (20, 21), (13, 101)])
def test_chunks_and_correlations_count_what_one_list_counts(monkeypatch, size, setting, value):
    some = random_planes(14, (2, *size))
    ends = points(some & random_planes(15, (2, *size)))
    bins = log_polar_bins(*size, (4, 40, 400), 12, CPU)
    listed = shape_contexts(ends, points(some), bins, 2)
    monkeypatch.setattr(shape_context, setting, value)
    if setting == "MOST_PAIRS":
        monkeypatch.setattr(torch, "repeat_interleave", None)  # nothing is left to list
    assert torch.equal(shape_contexts(ends, points(some), bins, 2), listed)


def test_layers_of_too_many_pairs_are_correlated(monkeypatch):
    """Isolated pixels, each a keypoint: 832 million pairs, a minute of listing; and beside them a
    layer of few points, which are listed."""
    dots = torch.zeros(1, 120, 961, dtype=torch.uint8)
    dots[:, ::2, ::2] = 1
    dots[:, ::40, ::40] |= 2
    listed = []
    repeat = torch.repeat_interleave

    def watched(counts, **options):
        listed.append(int(counts.sum()))
        return repeat(counts, **options)

    monkeypatch.setattr(torch, "repeat_interleave", watched)
    bins = log_polar_bins(120, 961, (100, 40_000), 12, CPU)
    all_of = points(dots)
    sums = shape_contexts(all_of, all_of, bins, 1)
    few = len(all_of.y[all_of.group == 1])
    assert sum(listed) == few**2 < 4 * bins.table.numel() < len(all_of.y) ** 2
    y, x = np.indices((2 * 120 - 1, 2 * 961 - 1)) - np.array([119, 960])[:, None, None]
    rows, columns = (np.maximum(0, n - np.abs(d) // 2) for n, d in ((60, y), (481, x)))
    pairs = np.where((y % 2 == 0) & (x % 2 == 0), rows * columns, 0)
    expected = np.bincount(bins.table.flatten(), pairs.ravel(), minlength=bins.total + 1)
    assert sums[0, 0].tolist() == expected[: bins.total].tolist()
