"""The Local Semantic Tensor against its equations as loops."""

import math

import numpy as np
import pytest
import torch
from plain_layers import Array, unit
from scipy.spatial.distance import cosine

from ssrvlad_torch.baselines.lost import class_sums, layout_cost, lost_descriptor

CLASSES = [0, 2, 3]


def mean_feature(features: Array, labels: Array, s: int) -> Array:
    """Eq. 2: the mean over the places whose most likely class is s."""
    members = [x for x, label in zip(features.T, labels, strict=True) if label == s]
    return sum(members) / len(members) if members else np.zeros(len(features))


def described(features: Array, probabilities: Array, means: list[Array]) -> Array:
    """Eq. 1: L_s = sum_i m_is |x_i - mu_s|, each of length 1, put one after another."""
    parts = []
    for s, mean in zip(CLASSES, means, strict=True):
        total = np.zeros(len(features))
        for x, odds in zip(features.T, probabilities.T, strict=True):
            total += odds[s] * np.abs(x - mean)
        parts.append(unit(total))
    return unit(np.concatenate(parts))


@pytest.mark.parametrize(("seed", "places"), [*((seed, 12) for seed in range(4)), (4, 2)])
def test_the_descriptor_is_the_equations(seed, places):
    """Of features ``(D, P)`` and probabilities ``(4, P)``; also where classes have no place."""
    rng = np.random.default_rng(seed)
    probabilities = rng.random((4, places))
    probabilities /= probabilities.sum(axis=0)
    features, labels = rng.normal(size=(5, places)), probabilities.argmax(axis=0)
    x, classes = torch.from_numpy(features), torch.tensor(CLASSES)
    sums, counts = class_sums(x, torch.from_numpy(labels), classes)
    means = [mean_feature(features, labels, s) for s in CLASSES]
    np.testing.assert_allclose((sums / counts.clamp(min=1)).numpy(), means, atol=1e-12)
    got = lost_descriptor(
        x, torch.from_numpy(probabilities)[classes], torch.tensor(np.array(means))
    )
    np.testing.assert_allclose(got.numpy(), described(features, probabilities, means), rtol=1e-9)


def pairs(seed: int, count: int = 20, width: int = 16):
    """Columns in two images, and distances between what is seen there."""
    rng = np.random.default_rng(seed)
    return rng.integers(1, width, (2, count)).astype(float), rng.random(count)


def cost(columns: tuple[np.ndarray, np.ndarray], distances: np.ndarray) -> float:
    one, other = (torch.tensor(np.array(side)) for side in columns)
    return layout_cost((one, other), torch.from_numpy(distances))


@pytest.mark.parametrize("seed", range(6))
def test_the_layout_cost_is_the_authors_steps(seed):
    (x, y), distances = pairs(seed)
    fractions = distances / np.abs(distances).sum()
    weights = fractions.max() - fractions
    expected = cosine(x * weights, y * weights) / np.linalg.norm(weights) / len(x)
    assert cost((x, y), distances) == pytest.approx(expected, rel=1e-9)


def test_an_image_with_itself_costs_nothing():
    """All pairs are equally near, so the authors' weights are all zero and their cost 0 / 0."""
    (x, _), distances = pairs(0)
    for equal in (0 * distances, 0 * distances + 0.3):
        assert cost((x, x), equal) == pytest.approx(0, abs=1e-12)
        assert cost((x, x[::-1]), equal) > 0


@pytest.mark.parametrize("count", [0, 1])
def test_one_pair_is_no_layout(count):
    columns, distances = pairs(0, count)
    assert cost(columns, distances) == math.inf
