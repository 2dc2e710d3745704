"""The NetVLAD network (Arandjelovic et al., CVPR 2016): image -> descriptor. VGG-16 is
configuration D of Simonyan and Zisserman, ICLR 2015; the layer is that of Section 3.1."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

VGG16_WIDTHS = (64, 128, 256, 512, 512)
"""Channels of each of the five blocks."""

_DEPTHS = (2, 2, 3, 3, 3)


def vgg16(widths: Sequence[int] = VGG16_WIDTHS) -> nn.Sequential:
    """The thirteen convolutions up to conv5_3, without its ReLU and without the last pooling, as in
    the authors' network and its ports; layers have the numbers of torchvision's
    ``vgg16().features``. ``(B, 3, H, W)`` float, sides of at least 16, give ``(B, widths[-1],
    H // 16, W // 16)``."""
    layers: list[nn.Module] = []
    channels = 3
    for width, depth in zip(widths, _DEPTHS, strict=True):
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            channels = width
        layers.append(nn.MaxPool2d(2))
    return nn.Sequential(*layers[:-2])


class NetVLADLayer(nn.Module):
    """Residuals to learnt centres, summed with soft assignment: ``(B, D, H, W)`` float give ``(B,
    K * D)`` of length 1, centre by centre. Parameters are named as in the PyTorch port: ``conv``
    holds w_k and b_k of Eq. 3, ``centroids`` c_k."""

    def __init__(self, clusters: int, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, clusters, 1)
        self.centroids = nn.Parameter(torch.rand(clusters, channels))

    def forward(self, maps: Tensor) -> Tensor:
        """The normalised vector of each image."""
        x = F.normalize(maps, dim=1)
        assignment = self.conv(x).flatten(2).softmax(dim=1)  # Eq. 3
        total = assignment.sum(dim=2)[..., None]
        residuals = assignment @ x.flatten(2).mT - total * self.centroids  # Eq. 4
        return F.normalize(F.normalize(residuals, dim=2).flatten(1), dim=1)


IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class NetVLADNetwork(nn.Module):
    """VGG-16 up to conv5_3, the NetVLAD layer with K ``clusters``, and PCA whitening to ``outputs``
    numbers, if not None. ``(B, 3, H, W)`` RGB from 0 to 255, uint8 or float, sides of at least 16,
    give ``(B, size)`` of length 1; ``size`` is ``outputs``, or ``clusters * widths[-1]``."""

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
