"""Networks that give features and class probabilities at once, for LoST-X."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from ..segmentation.onnx_network import OnnxNetwork
from .resnet101 import RESNET101_CHANNELS, resnet101
from .weights import find_weights

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
        weights: the file, or a folder with ``lost_x.onnx``; None looks in
            ``~/.cache/ssrvlad/weights``.

    Raises:
        FileNotFoundError: there is none; the message says where to get one.
        ValueError: it is not such a network.
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
        found = network(network.form(scaled), ["features", "scores"])
        return found["features"].float(), found["scores"].float()

    return run


class TrunkAndClassifier(nn.Module):
    """ResNet-101 and one layer of class scores: the least that LoST-X's own network costs.

    The authors' RefineNet-101 has the same trunk, whose conv5 gives the features, and a decoder
    on top.

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
