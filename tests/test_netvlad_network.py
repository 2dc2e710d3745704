"""Input scaling and whitening around VGG-16 and the NetVLAD layer."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain_layers import unit

from ssrvlad_torch.baselines.netvlad_network import NetVLADNetwork

WIDTHS = (2, 2, 2, 2, 3)


def small(outputs: int | None = 5) -> NetVLADNetwork:
    torch.manual_seed(0)
    return NetVLADNetwork(WIDTHS, clusters=4, outputs=outputs)


def test_the_published_sizes():
    with torch.device("meta"):
        network = NetVLADNetwork()
    assert network.whiten.weight.shape == (4096, 32768)
    sizes = {name: p.numel() for name, p in network.named_parameters() if "encoder" not in name}
    assert sizes["pool.centroids"] == sizes["pool.conv.weight"] == 64 * 512
    assert (network.size, NetVLADNetwork(WIDTHS, 4, None).size) == (4096, 12)


@torch.no_grad()
@pytest.mark.parametrize("outputs", [5, None])
def test_it_is_scaling_trunk_layer_and_whitening(outputs):
    network = small(outputs).double()
    network.mean.copy_(torch.tensor([1.0, 2, 3]))
    network.std.copy_(torch.tensor([4.0, 5, 6]))
    image = torch.randint(0, 256, (3, 33, 47), dtype=torch.uint8)
    scaled = (image.numpy() - np.array([[[1.0]], [[2]], [[3]]])) / [[[4.0]], [[5]], [[6]]]
    vlad = network.pool(network.encoder(torch.from_numpy(scaled)[None]))[0].numpy()
    if outputs:
        matrix, bias = network.whiten.weight.numpy(), network.whiten.bias.numpy()
        vlad = unit(np.array([sum(row * vlad) for row in matrix]) + bias)
    np.testing.assert_allclose(network(image[None])[0].numpy(), vlad, rtol=1e-9)


@torch.no_grad()
def test_shape_and_length():
    for outputs, length in ((5, 5), (None, 12)):
        descriptors = small(outputs)(torch.randint(0, 256, (2, 3, 48, 64), dtype=torch.uint8))
        assert descriptors.shape == (2, length)
        torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(2))
