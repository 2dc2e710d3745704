"""Input scaling and whitening around VGG-16 and the NetVLAD layer."""

import numpy as np
import pytest
import torch
from plain_layers import Array, convolve, max_pool, relu, unit
from torch import nn

from ssrvlad_torch.baselines.netvlad_network import NetVLADLayer, NetVLADNetwork, vgg16

WIDTHS = (2, 2, 2, 2, 3)


def test_the_published_sizes():
    with torch.device("meta"):
        network = NetVLADNetwork()
    assert network.whiten.weight.shape == (4096, 32768)
    sizes = {name: p.numel() for name, p in network.named_parameters() if "encoder" not in name}
    assert sizes["pool.centroids"] == sizes["pool.conv.weight"] == 64 * 512
    assert (network.size, NetVLADNetwork(WIDTHS, 4, None).size) == (4096, 12)
    network = network.encoder
    assert sum(p.numel() for p in network.parameters()) == 14_714_688
    shapes = {n: tuple(m.weight.shape) for n, m in enumerate(network) if isinstance(m, nn.Conv2d)}
    assert [*shapes] == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    assert (shapes[0], shapes[28]) == ((64, 3, 3, 3), (512, 512, 3, 3))
    assert len(network) == 29
    assert network(torch.zeros(1, 3, 64, 70, device="meta")).shape == (1, 512, 4, 4)


@torch.no_grad()
@pytest.mark.parametrize("outputs", [5, None])
def test_it_is_scaling_trunk_layer_and_whitening(outputs):
    torch.manual_seed(0)
    network = NetVLADNetwork(WIDTHS, clusters=4, outputs=outputs).double()
    network.mean.copy_(torch.tensor([1.0, 2, 3]))
    network.std.copy_(torch.tensor([4.0, 5, 6]))
    image = torch.randint(0, 256, (3, 33, 47), dtype=torch.uint8)
    scaled = (image.numpy() - np.array([[[1.0]], [[2]], [[3]]])) / [[[4.0]], [[5]], [[6]]]
    vlad = network.pool(network.encoder(torch.from_numpy(scaled)[None]))[0].numpy()
    if outputs:
        matrix, bias = network.whiten.weight.numpy(), network.whiten.bias.numpy()
        vlad = unit(np.array([sum(row * vlad) for row in matrix]) + bias)
    np.testing.assert_allclose(network(image[None])[0].numpy(), vlad, rtol=1e-9)


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


@torch.no_grad()
def test_it_is_thirteen_convolutions_and_four_poolings():
    torch.manual_seed(0)
    network = vgg16((2, 3, 2, 3, 2)).double()
    image = torch.rand(3, 17, 19, dtype=torch.float64)
    weights = [m for m in network if isinstance(m, nn.Conv2d)]
    maps = image.numpy()
    for number, conv in enumerate(weights):
        if number in (2, 4, 7, 10):
            maps = max_pool(maps, 2, 2)
        maps = convolve(maps, conv.weight.numpy(), conv.bias.numpy(), padding=1)
        if number < 12:
            maps = relu(maps)
    got = network(image[None])[0].numpy()
    assert got.shape == (2, 1, 1)
    np.testing.assert_allclose(got, maps, rtol=1e-9, atol=1e-12)
