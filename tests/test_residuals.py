import numpy as np
import pytest
import torch
import torch.nn.functional as F
from drawings import SPACE, blobs

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.stages import residuals
from ssrvlad_torch.stages.residuals import aggregate


def random_histograms(seed: int = 0):
    rng = np.random.default_rng(seed)
    sums = rng.integers(0, 2000, (3, 8, 60))
    centres = rng.integers(0, 50, (3, 8, 60))
    counts = rng.integers(0, 40, (3, 8))
    return sums, centres, counts


def test_equation_2_by_numpy():
    sums, centres, counts = random_histograms()
    descriptor = aggregate(*map(torch.from_numpy, (sums, centres, counts)))
    for b in range(3):
        blocks = [sums[b, k] - counts[b, k] * centres[b, k] for k in range(8)]
        vectors = np.concatenate([block / np.linalg.norm(block) for block in blocks])
        expected = vectors / np.linalg.norm(vectors)
        np.testing.assert_allclose(descriptor[b], expected, rtol=0, atol=1e-7)
    assert descriptor.dtype == torch.float32


def test_zero_layers_stay_exactly_zero():
    sums, centres, counts = map(torch.from_numpy, random_histograms(2))
    sums[0, 2], counts[0, 2] = 0, 0
    sums[1], counts[1] = 0, 0
    sums[2, 5] = counts[2, 5] * centres[2, 5]
    descriptor = aggregate(sums, centres, counts).unflatten(1, (8, 60))
    assert not descriptor[0, 2].any()
    assert not descriptor[1].any()
    assert not descriptor[2, 5].any()
    assert descriptor.isfinite().all()


def test_mirrored_histograms_exchange_sectors():
    """Points beside the axes, so that no point lies between two sectors."""
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE)
    bins = torch.arange(8 * 60.0).view(8, 5, 12)
    exchanged = residuals.mirrored(bins.flatten(), config).view(8, 5, 12)
    assert torch.equal(exchanged[..., :6], bins[..., :6].flip(-1))
    assert torch.equal(exchanged[..., 6:], bins[..., 6:].flip(-1))


@pytest.mark.parametrize("sectors", [12, 9])
def test_mirrored_descriptors_are_near_those_of_mirrored_label_maps(sectors):
    config = SSRVLADConfig.from_preset("paper", labels_as=SPACE, sectors=sectors)
    head = SSRVLAD(config)
    labels = torch.from_numpy(np.stack([blobs(seed, 90, 120, 15) for seed in range(8)]))
    found, expected = head(labels), head(labels.flip(-1).contiguous())
    alike = F.cosine_similarity(residuals.mirrored(found, config), expected)
    assert alike.min() > F.cosine_similarity(found, expected).mean() + 0.1
    assert torch.equal(residuals.mirrored(residuals.mirrored(found, config), config), found)
