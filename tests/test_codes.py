"""Codes of descriptors against the scores that they stand for."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import descriptors, grids
from oracles.recognition import cosines_of_signs

from ssrvlad_torch.channels.signs import numbers
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.search.codes import Coder


@pytest.mark.parametrize("shape", [(8, 3, 4), (5, 3, 9), (1, 2, 1)])
@pytest.mark.parametrize("sweep", [True, False])
def test_codes_of_signs_are_nearly_scored_as_some_bytes_of_each_cell(shape, sweep):
    """Rows that lie in 100 dimensions; of the moves the best counts."""
    rows, queries = grids(100, shape), grids(3, shape, 1)
    some = [numbers(signs[..., :: max(1, shape[2] // 4)]).numpy() for signs in (queries, rows)]
    moves = [
        min(most, cells - 1) if sweep else 0 for most, cells in zip((3, 2), shape, strict=False)
    ]
    expected = cosines_of_signs(*some, *moves)
    coder = Coder.learn(rows)
    got = coder.scores(queries, coder.codes(rows), sweep)
    torch.testing.assert_close(got, torch.from_numpy(expected).float(), atol=0.03, rtol=0)


@pytest.mark.parametrize("anchors", [None, 3])
@pytest.mark.parametrize("sweep", [True, False])
def test_codes_of_vectors_are_nearly_exact(anchors, sweep):
    """Vectors that lie in 20 dimensions; of a sweep the best anchor counts."""
    inside, mean = torch.linalg.qr(descriptors(0, 90, 20))[0], descriptors(3, 1, 90)
    rows = 2 * F.normalize(descriptors(1, 130, 20) @ inside.T + mean, dim=1)
    shape = (4, anchors) if anchors else (4,)
    queries = (descriptors(2, 4 * (anchors or 1), 20) @ inside.T).view(*shape, 90)
    coder = Coder.learn(F.normalize(descriptors(4, 500, 20) @ inside.T + mean, dim=1))
    codes = coder.codes(rows)
    assert codes.dtype == np.int8 and codes.shape == (130, 64) and np.abs(codes).max() > 50
    usual = queries if sweep or not anchors else queries[:, 1]
    torch.testing.assert_close(
        coder.scores(queries, codes, sweep), score(usual, rows), atol=0.03, rtol=0
    )
