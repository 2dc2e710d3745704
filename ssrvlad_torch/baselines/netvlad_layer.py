"""The NetVLAD layer (Arandjelovic et al., CVPR 2016, Section 3.1)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class NetVLADLayer(nn.Module):
    """Residuals to learnt centres, summed with soft assignment.

    Names and shapes of the parameters are those of the PyTorch port: ``conv`` holds w_k and b_k
    of Eq. 3, ``centroids`` c_k.

    Shape:
        - input: ``(B, D, H, W)`` float
        - output: ``(B, K * D)`` of length 1, centre by centre
    """

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
