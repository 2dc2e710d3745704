"""AlexNet-Places365 up to conv3 (Zhou et al., TPAMI 2018), after its published prototxt."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

_SIDE = 227
_MEAN_BGR = (104.051, 112.514, 116.676)
"""Mean pixel of ``places365CNN_mean.binaryproto``."""


class AlexNetPlaces365(nn.Module):
    """The first three convolutions; the layers after conv3 are not needed and have no place here.

    Names and shapes of the parameters are Caffe's. It is Caffe's AlexNet: two groups in conv2,
    pooling before normalisation, pixels in the order blue, green, red. torchvision's AlexNet is
    another network.

    Shape:
        - input: ``(B, 3, H, W)`` RGB from 0 to 255, uint8 or float; resized to 227 x 227
        - output: ``(B, 384, 13, 13)`` float32, after the ReLU
    """

    mean: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(_MEAN_BGR)[:, None, None], persistent=False)
        self.conv1 = nn.Conv2d(3, 96, 11, stride=4)
        self.conv2 = nn.Conv2d(96, 256, 5, padding=2, groups=2)
        self.conv3 = nn.Conv2d(256, 384, 3, padding=1)
        self.pool = nn.MaxPool2d(3, stride=2)
        self.norm = nn.LocalResponseNorm(5, alpha=1e-4, beta=0.75)
        for conv in (self.conv1, self.conv2, self.conv3):
            nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        """The maps of conv3 of each image."""
        small = F.interpolate(images.float(), (_SIDE, _SIDE), mode="bilinear", align_corners=False)
        x = small.flip(1) - self.mean
        x = self.norm(self.pool(F.relu(self.conv1(x))))
        x = self.norm(self.pool(F.relu(self.conv2(x))))
        return F.relu(self.conv3(x))
