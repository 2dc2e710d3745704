"""The whole NetVLAD network (Arandjelovic et al., CVPR 2016): image -> descriptor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .netvlad_layer import NetVLADLayer
from .vgg16 import VGG16_WIDTHS, vgg16

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class NetVLADNetwork(nn.Module):
    """VGG-16 up to conv5_3, the NetVLAD layer, and PCA whitening where the weights have it.

    Args:
        widths: channels of the five blocks of VGG-16.
        clusters: K of the layer.
        outputs: length of the whitened descriptor, None for no whitening.

    Shape:
        - input: ``(B, 3, H, W)`` RGB from 0 to 255, uint8 or float, H and W at least 16
        - output: ``(B, size)`` of length 1; ``size`` is ``outputs``, or ``clusters * widths[-1]``
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        widths: Sequence[int] = VGG16_WIDTHS,
        clusters: int = 64,
        outputs: int | None = 4096,
    ) -> None:
        super().__init__()
        self.register_buffer("mean", 255 * torch.tensor(IMAGENET_MEAN))
        self.register_buffer("std", 255 * torch.tensor(IMAGENET_STD))
        self.encoder = vgg16(widths)
        self.pool = NetVLADLayer(clusters, widths[-1])
        size = clusters * widths[-1]
        self.whiten = None if outputs is None else nn.Linear(size, outputs)
        self.size = outputs or size

    def forward(self, images: Tensor) -> Tensor:
        """The descriptor of each image."""
        scaled = (images - self.mean[:, None, None]) / self.std[:, None, None]
        vlad: Tensor = self.pool(self.encoder(scaled))
        return vlad if self.whiten is None else F.normalize(self.whiten(vlad), dim=1)
