"""Image -> descriptors of its regions: the first half of Region-VLAD."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from .alexnet import AlexNetPlaces365
from .caffemodel import read_caffemodel
from .protocol import Image
from .regions import region_descriptors
from .weights import fill, find_weights, random_network, read_checkpoint

_FILES = ("alexnet_places365.caffemodel", "alexnet_places365.caffemodel.pt")
_ORIGIN = "the Places365 project (github.com/CSAILVision/places365)"
_PYTORCH = (b"PK\x03\x04", b"\x80\x02")
"""How PyTorch files begin, of the present format and of the one before 1.6."""


class RegionFeatures:
    """conv3 of AlexNet-Places365 and the regions in it with the highest energy.

    Args:
        weights: ``alexnet_places365.caffemodel`` as published, or a PyTorch file with the same
            layers by Caffe's names (``conv1.weight``, ``conv1.bias``, ... ``conv3.bias``); or a
            folder with one of them; None looks in ``~/.cache/ssrvlad/weights``.
        random_weights: only to measure costs.
        regions: N, the most regions of an image.
        device: where the network runs.

    Raises:
        FileNotFoundError: there are no weights; the message says where to get them.
        ValueError: the weights are damaged or do not fit.
    """

    def __init__(
        self,
        weights: str | Path | None = None,
        random_weights: bool = False,
        regions: int = 400,
        device: str = "cpu",
    ) -> None:
        network = random_network(AlexNetPlaces365) if random_weights else _trained(weights)
        self._network = network.to(device)
        self._regions = regions
        self._device = device

    @torch.no_grad()
    def __call__(self, images: Iterable[Image]) -> Iterator[Tensor]:
        """``(R, 384)`` float32 for each ``(H, W, 3)`` uint8 RGB image, R at most ``regions``."""
        for image in images:
            pixels = torch.tensor(image, device=self._device).permute(2, 0, 1)
            yield region_descriptors(self._network(pixels[None])[0], self._regions).cpu()


def _trained(weights: str | Path | None) -> AlexNetPlaces365:
    path = find_weights(weights, _FILES, _ORIGIN)
    with path.open("rb") as file:
        pytorch = file.read(4).startswith(_PYTORCH)
    network = AlexNetPlaces365()
    fill(network, read_checkpoint(path) if pytorch else read_caffemodel(path), path)
    return network.eval()
