"""Sums of descriptors, of which means are made."""

import numpy as np
import torch
import torch.nn.functional as F

from ssrvlad_torch.search.sums import sums


def test_sums_are_of_vectors_at_length_1_and_of_signs_as_1_and_minus_1():
    """Empty frames do not count; 300 frames are more than a byte counts."""
    vectors = torch.randn(40, 8, generator=torch.Generator().manual_seed(0))
    vectors[3:6] = 0
    total, count = sums(vectors)
    assert count == 37
    np.testing.assert_allclose(total, F.normalize(vectors, dim=1).double().sum(0), atol=1e-6)
    signs = np.random.default_rng(0).integers(0, 256, (300, 4, 3, 2), np.uint8)
    total, count = sums(torch.from_numpy(signs))
    bits = np.unpackbits(signs.reshape(300, 4, 6), axis=2, bitorder="little")
    np.testing.assert_array_equal(total, (2.0 * bits - 1).sum(0))
    assert count == 300
