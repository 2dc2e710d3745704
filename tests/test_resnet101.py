"""ResNet-101: its published size, its blocks, its stride."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from plain_layers import Array, convolve, relu
from torch import nn

from ssrvlad_torch.baselines.resnet101 import Bottleneck, resnet101


def test_it_has_the_published_size():
    """44,549,160 with the classifier of 2048 x 1000 + 1000."""
    with torch.device("meta"):
        network = resnet101()
    assert sum(p.numel() for p in network.parameters()) == 44_549_160 - 2_049_000
    assert sum(isinstance(m, nn.Conv2d) for m in network.modules()) == 100 + 4  # and 4 shortcuts


@torch.no_grad()
def test_its_stride_is_32():
    assert resnet101().eval()(torch.zeros(1, 3, 65, 96)).shape == (1, 2048, 3, 3)


@torch.no_grad()
@pytest.mark.parametrize(("channels", "stride"), [(8, 1), (8, 2), (5, 1)])
def test_a_block_is_three_convolutions_beside_a_shortcut(channels, stride):
    torch.manual_seed(0)
    block = Bottleneck(channels, 2, stride).double().eval()
    for norm in block.modules():
        if isinstance(norm, nn.BatchNorm2d):
            for tensor in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
                tensor.copy_(torch.rand_like(tensor) + 0.5)

    def layer(part: nn.Sequential, maps: Array) -> Array:
        conv, norm = part
        scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).numpy()
        zero = np.zeros(conv.out_channels)
        maps = convolve(maps, conv.weight.numpy(), zero, conv.stride[0], conv.padding[0])
        shift = norm.bias.numpy() - norm.running_mean.numpy() * scale
        return maps * scale[:, None, None] + shift[:, None, None]

    image = torch.randn(channels, 5, 6, dtype=torch.float64)
    x = image.numpy()
    first, _, second, _, third = block.residual
    changes = (channels, stride) != (8, 1)
    beside = layer(block.shortcut, x) if changes else x
    expected = relu(layer(third, relu(layer(second, relu(layer(first, x))))) + beside)
    np.testing.assert_allclose(block(image[None])[0].numpy(), expected, rtol=1e-9, atol=1e-12)
