"""ResNet-101 up to its last convolutional stage (He et al., CVPR 2016)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

RESNET101_CHANNELS = 2048

_DEPTHS = (3, 4, 23, 3)
_EXPANSION = 4


def resnet101() -> nn.Sequential:
    """The network without its pooling and classifier, stride in the 3 x 3 convolutions.

    Shape:
        - input: ``(B, 3, H, W)`` float
        - output: ``(B, 2048, ceil(H / 32), ceil(W / 32))`` float
    """
    layers: list[nn.Module] = [_convolution(3, 64, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, padding=1)]
    channels = 64
    for stage, depth in enumerate(_DEPTHS):
        for block in range(depth):
            stride = 2 if stage > 0 and block == 0 else 1
            layers.append(Bottleneck(channels, 64 << stage, stride))
            channels = _EXPANSION * (64 << stage)
    return nn.Sequential(*layers)


class Bottleneck(nn.Module):
    """Three convolutions beside a shortcut, which is a convolution where the shape changes.

    Shape:
        - input: ``(B, channels, H, W)`` float
        - output: ``(B, 4 * width, ceil(H / stride), ceil(W / stride))`` float
    """

    def __init__(self, channels: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = _EXPANSION * width
        self.residual = nn.Sequential(
            _convolution(channels, width, 1, 1),
            nn.ReLU(),
            _convolution(width, width, 3, stride),
            nn.ReLU(),
            _convolution(width, outputs, 1, 1),
        )
        changes = stride != 1 or channels != outputs
        self.shortcut = _convolution(channels, outputs, 1, stride) if changes else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Residual and shortcut together."""
        return F.relu(self.residual(x) + self.shortcut(x))


def _convolution(channels: int, outputs: int, side: int, stride: int) -> nn.Sequential:
    conv = nn.Conv2d(channels, outputs, side, stride, padding=side // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))
