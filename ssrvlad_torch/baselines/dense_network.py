"""Networks with two outputs, features and class probabilities, for LoST-X.

One of them uses ResNet-101 up to its last convolutional stage (He et al., CVPR 2016).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..segmentation.onnx_network import OnnxNetwork
from .weights import find_weights

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
        """The sum of residual and shortcut."""
        return F.relu(self.residual(x) + self.shortcut(x))


def _convolution(channels: int, outputs: int, side: int, stride: int) -> nn.Sequential:
    conv = nn.Conv2d(channels, outputs, side, stride, padding=side // 2, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


DenseNetwork = Callable[[Tensor], tuple[Tensor, Tensor]]
"""``(1, 3, H, W)`` RGB from 0 to 1 -> ``(1, D, h, w)`` features, ``(1, C, h', w')`` probabilities.

Both float; channel c of the probabilities, at any resolution, stands for id c of a label space.
"""

_FILES = ("lost_x.onnx",)
_ORIGIN = (
    "nobody in this form: export a segmentation network with the outputs features and scores "
    "(the authors took conv5 and the class probabilities of RefineNet-101 for Cityscapes, "
    "github.com/guosheng/refinenet)"
)


def load_dense_network(weights: str | Path | None) -> DenseNetwork:
    """A network from an ONNX file with the outputs ``features`` and ``scores``.

    Args:
        weights: the file, or a folder with ``lost_x.onnx``; None is ``~/.cache/ssrvlad/weights``.

    Raises:
        FileNotFoundError: the file does not exist; the message says where to get one.
        ValueError: the network has other outputs.
        ImportError: the extra ``onnx`` is not installed.
    """
    path = find_weights(weights, _FILES, _ORIGIN)
    network = OnnxNetwork(path)
    missing = {"features", "scores"} - network.outputs.keys()
    if missing:
        has = ", ".join(network.outputs)
        raise ValueError(f"{path} must have the outputs features and scores, it has {has}")

    def run(images: Tensor) -> tuple[Tensor, Tensor]:
        scaled = 255 * images if network.form.dtype == torch.uint8 else images
        outputs = network(network.form(scaled), ["features", "scores"])
        return outputs["features"].float(), outputs["scores"].float()

    return run


class TrunkAndClassifier(nn.Module):
    """ResNet-101 and one layer of class scores, to measure the least cost of LoST-X.

    The authors' RefineNet-101 has the same trunk, whose conv5 gives the features, and also a
    decoder.

    Shape:
        - input: ``(B, 3, H, W)`` RGB from 0 to 1
        - output: ``(B, 2048, H / 32, W / 32)`` and ``(B, classes, H / 32, W / 32)`` float
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.trunk = resnet101()
        self.classifier = nn.Conv2d(RESNET101_CHANNELS, classes, 1)

    @torch.no_grad()
    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Features and class probabilities."""
        features = self.trunk(images)
        return features, self.classifier(features).softmax(dim=1)
