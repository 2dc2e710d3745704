import pytest
import torch
from drawings import random_planes

from ssrvlad_torch.stages import shape_context
from ssrvlad_torch.stages.bitplanes import points
from ssrvlad_torch.stages.shape_context import log_polar_bins, shape_contexts

CPU = torch.device("cpu")


@pytest.mark.parametrize("pairs", [1000, 997])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (13, 101)])
def test_chunks_count_what_one_list_counts(monkeypatch, size, pairs):
    pixels = random_planes(14, (2, *size))
    ends = points(pixels & random_planes(15, (2, *size)))
    bins = log_polar_bins(*size, (4, 40, 400), 12, CPU)
    whole = shape_contexts(ends, points(pixels), bins, 2)
    monkeypatch.setattr(shape_context, "PAIRS_AT_ONCE", pairs)
    assert torch.equal(shape_contexts(ends, points(pixels), bins, 2), whole)
