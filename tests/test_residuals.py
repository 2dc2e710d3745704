import numpy as np
import torch
from drawings import SPACE

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.stages.residuals import ResidualHistograms, Residuals

PAPER = SSRVLADConfig.from_preset("paper", labels_as=SPACE)


def test_the_descriptor_is_equation_2_in_numpy():
    rng = np.random.default_rng(0)
    points, centre = rng.integers(0, 2000, (4, 8, 60)), rng.integers(0, 50, (4, 8, 60))
    counts = rng.integers(1, 40, (4, 8))
    points[0, 2], counts[0, 2] = 0, 0  # layers without keypoints, and one that sees the same
    points[1], counts[1] = 0, 0
    points[2, 5] = counts[2, 5] * centre[2, 5]
    bins = (torch.from_numpy(each).view(4, 8, 5, 12) for each in (points, centre))
    histograms = ResidualHistograms(*bins, torch.from_numpy(counts), torch.empty(0))
    descriptor = Residuals(PAPER).descriptor(histograms)
    assert descriptor.dtype == torch.float32
    for found, *image in zip(descriptor, points, counts, centre, strict=True):
        blocks = [p - n * c for p, n, c in zip(*image, strict=True)]
        vectors = np.concatenate([block / (np.linalg.norm(block) or 1) for block in blocks])
        expected = vectors / (np.linalg.norm(vectors) or 1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)
        assert not found[torch.from_numpy(expected == 0)].any()
