"""The cost of a layout: the authors' steps in SciPy, and what it means."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cosine

from ssrvlad_torch.baselines.spatial_layout import layout_cost


def pairs(seed: int, count: int = 20, width: int = 16):
    """Columns in two images, and distances between what is seen there."""
    rng = np.random.default_rng(seed)
    return rng.integers(1, width, (2, count)).astype(float), rng.random(count)


def cost(columns: tuple[np.ndarray, np.ndarray], distances: np.ndarray) -> float:
    one, other = (torch.tensor(np.array(side)) for side in columns)
    return layout_cost((one, other), torch.from_numpy(distances))


@pytest.mark.parametrize("seed", range(6))
def test_the_authors_steps(seed):
    (x, y), distances = pairs(seed)
    fractions = distances / np.abs(distances).sum()
    weights = fractions.max() - fractions
    expected = cosine(x * weights, y * weights) / np.linalg.norm(weights) / len(x)
    assert cost((x, y), distances) == pytest.approx(expected, rel=1e-9)


def test_the_same_order_costs_nothing_and_the_reverse_more_than_a_shuffle():
    (x, _), distances = pairs(0)
    x.sort()
    shuffled = np.random.default_rng(1).permutation(x)
    assert cost((x, x), distances) == pytest.approx(0, abs=1e-12)
    assert 0 < cost((x, shuffled), distances) < cost((x, x[::-1]), distances)


def test_pairs_that_look_alike_weigh_more():
    x, y = np.array([1.0, 5, 9, 3]), np.array([1.0, 5, 3, 9])
    swapped_are_far, swapped_are_near = np.array([0, 0, 0.5, 1]), np.array([0.5, 1, 0, 0])
    assert cost((x, y), swapped_are_far) < cost((x, y), swapped_are_near)


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
