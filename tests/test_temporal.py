"""Eq. 3 against a loop."""

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from ssrvlad_torch.recognition.temporal import temporal_sum


def plain_temporal_sum(descriptors, sequences, reach):
    """Eq. 3 frame by frame."""
    summed = np.zeros_like(descriptors)
    for i in range(len(descriptors)):
        if not descriptors[i].any():
            continue
        for j in range(max(0, i - reach), min(len(descriptors), i + reach + 1)):
            if sequences[j] == sequences[i]:
                summed[i] += descriptors[j]
        length = np.linalg.norm(summed[i])
        summed[i] = summed[i] / length if length else 0
    return summed


@given(st.lists(st.integers(0, 6), max_size=4), st.integers(0, 9), st.integers(0, 2**32 - 1))
@example([3], 100, 0)  # a reach beyond the sequence
@example([6, 6, 6], 2, 1)  # empty frames among others
def test_temporal_sum_equals_a_loop(lengths, reach, seed):
    rng = np.random.default_rng(seed)
    sequences = [f"sequence {9 - s}" for s, length in enumerate(lengths) for _ in range(length)]
    descriptors = rng.uniform(0.1, 1, (len(sequences), 5)).astype(np.float32)
    descriptors[rng.random(len(sequences)) < 0.2] = 0
    before = descriptors.copy()
    summed = temporal_sum(descriptors, sequences, reach)
    np.testing.assert_array_equal(descriptors, before)
    expected = plain_temporal_sum(descriptors.astype(np.float64), sequences, reach)
    np.testing.assert_allclose(summed.numpy(), expected, rtol=0, atol=1e-6)
    assert summed.dtype == torch.float32


def test_temporal_sum_refuses_wrong_arguments():
    with pytest.raises(ValueError, match="a sequence for each of 3 frames, got 2"):
        temporal_sum(torch.eye(3), ["a", "a"], 1)
    with pytest.raises(ValueError, match="0 or more frames, got -1"):
        temporal_sum(torch.eye(3), ["a"] * 3, -1)
