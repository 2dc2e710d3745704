"""The NetVLAD layer against Eq. 4 written as loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain_layers import Array, unit

from ssrvlad_torch.baselines.netvlad_layer import NetVLADLayer


def described(maps: Array, w: Array, b: Array, c: Array) -> Array:
    """Eq. 4: V(j, k) = sum_i softmax_k(w_k x_i + b_k) (x_i(j) - c_k(j)), then the two norms."""
    clusters, channels = w.shape
    v = np.zeros((clusters, channels))
    for x in map(unit, maps.reshape(channels, -1).T):
        odds = np.exp(w @ x + b)
        for k in range(clusters):
            for j in range(channels):
                v[k, j] += odds[k] / odds.sum() * (x[j] - c[k, j])
    return unit(np.concatenate([unit(row) for row in v]))


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_it_is_equation_4(seed):
    torch.manual_seed(seed)
    layer = NetVLADLayer(clusters=4, channels=5).double()
    maps = torch.randn(2, 5, 3, 4, dtype=torch.float64)
    w, b = layer.conv.weight.flatten(1).numpy(), layer.conv.bias.numpy()
    expected = [described(m, w, b, layer.centroids.numpy()) for m in maps.numpy()]
    np.testing.assert_allclose(layer(maps).numpy(), expected, rtol=1e-9)


def test_the_published_size():
    layer = NetVLADLayer(64, 512)
    assert layer.centroids.shape == (64, 512)
    assert layer.conv.weight.shape == (64, 512, 1, 1)
    assert layer(torch.rand(1, 512, 2, 3)).shape == (1, 32768)


@torch.no_grad()
def test_parts_of_all_centres_weigh_the_same():
    vector = NetVLADLayer(4, 6)(torch.randn(1, 6, 3, 3)).reshape(4, 6)
    torch.testing.assert_close(vector.norm(dim=1), torch.full((4,), 0.5))


@torch.no_grad()
def test_the_order_of_places_and_the_scale_of_features_do_not_count():
    torch.manual_seed(0)
    layer, maps = NetVLADLayer(3, 4), torch.randn(1, 4, 3, 5)
    shuffled = maps.flatten(2)[..., torch.randperm(15)].reshape(1, 4, 5, 3)
    torch.testing.assert_close(layer(3 * shuffled), layer(maps))
