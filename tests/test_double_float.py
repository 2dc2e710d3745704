"""Sums of two float32 in a graph, against float64."""

import numpy as np
import pytest
import torch
from graphs import run

from ssrvlad_torch.deployment.double_float import DoubleFloat, product, root, weighted_means


def whole(graph, number):
    """Both halves, to be added in float64 outside of the graph."""
    return [number.high, number.low]


@pytest.mark.parametrize("rows", [1, 6, 480])
def test_means_of_whole_numbers(rows):
    """Also where few columns take many rows: what is cut off each weight adds up."""
    random = np.random.default_rng(rows)
    weights = random.random((rows, 5))
    weights /= weights.sum(0)
    numbers = random.integers(0, 1 << 24, (2, 3, rows))
    given = torch.from_numpy(numbers).float()
    high, low = run(lambda graph, x: whole(graph, weighted_means(graph, x, weights)), given)
    expected = torch.from_numpy(numbers @ weights)
    torch.testing.assert_close(high.double() + low.double(), expected, rtol=1e-11, atol=0)


def test_roots_and_products():
    random = np.random.default_rng(0)
    numbers = random.random((1, 2, 40))
    high = torch.from_numpy(numbers).float()
    low = torch.from_numpy(numbers - high.double().numpy()).float()
    table = random.standard_normal((40, 7))

    def both(graph, high, low):
        found = root(graph, DoubleFloat(high, low))
        return [*whole(graph, found), product(graph, found, table)]

    near, rest, products = run(both, high, low)
    expected = np.sqrt(numbers)
    roots = torch.from_numpy(expected)
    torch.testing.assert_close(near.double() + rest.double(), roots, rtol=0, atol=1e-11)
    torch.testing.assert_close(products, torch.from_numpy(expected @ table).float())


def test_what_cancels_leaves_next_to_nothing():
    """Where float32 would leave 1e-7, which the power normalisation makes 5e-6."""
    random = np.random.default_rng(1)
    numbers = random.random((1, 1, 60))
    numbers = np.concatenate([numbers, numbers], 2)
    high = torch.from_numpy(numbers).float()
    low = torch.from_numpy(numbers - high.double().numpy()).float()
    column = random.standard_normal(60)
    table = np.concatenate([column, -column])[:, None]
    (left,) = run(lambda graph, h, lo: [product(graph, DoubleFloat(h, lo), table)], high, low)
    assert left.abs().max() < 1e-8
