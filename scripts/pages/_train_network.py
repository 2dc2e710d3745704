"""A compact segmentation network for a processor: under one million weights, four strides."""

from __future__ import annotations

from itertools import pairwise

import torch.nn.functional as F
from torch import Tensor, nn

WIDTHS = (16, 32, 64, 96)


class CompactNetwork(nn.Module):
    """Images -> class scores: a residual encoder, and a decoder that adds the finer features.

    Shape:
        - input: ``(B, 3, H, W)`` normalised images, any ``H`` and ``W`` from 16.
        - output: ``(B, classes, H, W)`` logits.
    """

    def __init__(self, classes: int, widths: tuple[int, ...] = WIDTHS) -> None:
        super().__init__()
        inputs = (3, *widths)
        self.encoder = nn.ModuleList(
            nn.Sequential(
                _convolution(few, many, stride=2), *[_Residual(many) for _ in range(deep)]
            )
            for deep, (few, many) in enumerate(zip(inputs, widths, strict=False))
        )
        coarse_to_fine = widths[::-1]
        self.lateral = nn.ModuleList(
            _convolution(many, few, size=1) for many, few in pairwise(coarse_to_fine)
        )
        self.decoder = nn.ModuleList(_Residual(width) for width in coarse_to_fine[1:])
        self.scores = nn.Conv2d(widths[0], classes, 1)

    def forward(self, images: Tensor) -> Tensor:
        """The class scores of every pixel."""
        features = [images]
        for stage in self.encoder:
            features.append(stage(features[-1]))
        found = features.pop()
        for lateral, refine in zip(self.lateral, self.decoder, strict=True):
            finer = features.pop()
            enlarged = F.interpolate(
                lateral(found), size=finer.shape[2:], mode="bilinear", align_corners=False
            )
            found = refine(finer + enlarged)
        scores = self.scores(found)
        return F.interpolate(scores, size=images.shape[2:], mode="bilinear", align_corners=False)


class _Residual(nn.Module):
    """Two convolutions beside a short cut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _convolution(width, width), _convolution(width, width)

    def forward(self, features: Tensor) -> Tensor:
        found: Tensor = features + self.second(self.first(features))
        return found


def _convolution(few: int, many: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(few, many, size, stride, size // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(many), nn.ReLU(inplace=True))
