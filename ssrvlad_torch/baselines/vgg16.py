"""VGG-16 up to its last convolution (Simonyan and Zisserman, ICLR 2015, configuration D)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn

VGG16_WIDTHS = (64, 128, 256, 512, 512)
"""Channels of each of the five blocks."""

_DEPTHS = (2, 2, 3, 3, 3)


def vgg16(widths: Sequence[int] = VGG16_WIDTHS) -> nn.Sequential:
    """The thirteen convolutions, cut after conv5_3: neither its ReLU nor the last pooling.

    NetVLAD is cut there in the authors' network and in its ports. The numbers of the layers are
    those of torchvision's ``vgg16().features``, so published names fit.

    Shape:
        - input: ``(B, 3, H, W)`` float, H and W at least 16
        - output: ``(B, widths[-1], H // 16, W // 16)`` float
    """
    layers: list[nn.Module] = []
    channels = 3
    for width, depth in zip(widths, _DEPTHS, strict=True):
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers[:-2])
