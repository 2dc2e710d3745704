"""Standardise: which traverses share a mean."""

import pytest

from ssrvlad_torch.recognition.standardise import sharing


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([40, 50], {(0,): (0,), (1,): (1,)}),
        ([40, 4], {(0,): (0,), (1,): (0, 1)}),
        ([20, 20, 40], {(0, 1): (0, 1), (2,): (2,)}),
        ([5, 40, 29, 1], {(0,): (0, 1, 2, 3), (1,): (1,), (2, 3): (2, 3)}),
        ([2, 27], {}),
        ([], {}),
    ],
)
def test_short_traverses_share_a_mean_with_their_neighbours_or_all(frames, expected):
    assert sharing(frames) == expected
