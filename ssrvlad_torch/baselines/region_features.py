"""Image -> descriptors of its regions: the first half of Region-VLAD. The network is
AlexNet-Places365 up to conv3 (Zhou et al., TPAMI 2018), after its published prototxt."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..channels.channel import Picture
from .caffemodel import read_caffemodel
from .regions import region_descriptors
from .weights import fill, find_weights, random_network, read_checkpoint

_SIDE = 227
_MEAN_BGR = (104.051, 112.514, 116.676)
"""Mean pixel of ``places365CNN_mean.binaryproto``."""


class AlexNetPlaces365(nn.Module):
    """The first three convolutions of Caffe's AlexNet, with Caffe's names and shapes of the
    parameters: two groups in conv2, pooling before normalisation, pixels in the order blue, green,
    red. ``(B, 3, H, W)`` RGB from 0 to 255, uint8 or float, is resized to 227 x 227 and gives ``(B,
    384, 13, 13)`` float32, after the ReLU of conv3."""

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


_FILES = ("alexnet_places365.caffemodel", "alexnet_places365.caffemodel.pt")
_ORIGIN = "the Places365 project (github.com/CSAILVision/places365)"
_PYTORCH = (b"PK\x03\x04", b"\x80\x02")
"""First bytes of PyTorch files, of the present format and of the one before 1.6."""


class RegionFeatures:
    """conv3 of AlexNet-Places365 and the at most ``regions`` regions in it with the highest energy.

    Weights are ``alexnet_places365.caffemodel`` as published, or a PyTorch file with the same
    layers by Caffe's names, from ``conv1.weight`` to ``conv3.bias``; for folders and errors see
    `find_weights`. Random ones are for measuring costs.
    """

    def __init__(
        self,
        weights: str | Path | None = None,
        random_weights: bool = False,
        regions: int = 400,
        device: str = "cpu",
    ) -> None:
        if random_weights:
            network = random_network(AlexNetPlaces365)
        else:
            path, network = find_weights(weights, _FILES, _ORIGIN), AlexNetPlaces365().eval()
            with path.open("rb") as file:
                pytorch = file.read(4).startswith(_PYTORCH)
            fill(network, read_checkpoint(path) if pytorch else read_caffemodel(path), path)
        self._network = network.to(device)
        self._regions = regions
        self._device = device

    @torch.no_grad()
    def __call__(self, images: Iterable[Picture]) -> Iterator[Tensor]:
        """``(R, 384)`` float32 for each ``(H, W, 3)`` uint8 RGB image, R at most ``regions``."""
        for image in images:
            pixels = torch.tensor(image, device=self._device).permute(2, 0, 1)
            yield region_descriptors(self._network(pixels[None])[0], self._regions).cpu()
