"""VGG-16 up to conv5_3: against loops, its layers' numbers, and its published size."""

from __future__ import annotations

import numpy as np
import torch
from plain_layers import convolve, max_pool, relu
from torch import nn

from ssrvlad_torch.baselines.vgg16 import vgg16


def test_it_has_the_published_size():
    with torch.device("meta"):
        network = vgg16()
    assert sum(p.numel() for p in network.parameters()) == 14_714_688
    shapes = {n: tuple(m.weight.shape) for n, m in enumerate(network) if isinstance(m, nn.Conv2d)}
    assert [*shapes] == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    assert shapes[0] == (64, 3, 3, 3)
    assert shapes[28] == (512, 512, 3, 3)
    assert len(network) == 29


def test_one_real_size():
    assert vgg16()(torch.zeros(1, 3, 64, 70)).shape == (1, 512, 4, 4)


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


@torch.no_grad()
def test_the_last_convolution_keeps_its_signs():
    torch.manual_seed(0)
    maps = vgg16((4, 4, 4, 4, 8))(torch.rand(1, 3, 32, 32))
    assert bool((maps < 0).any())
