"""Region-VLAD (Khaliq, Ehsan, Chen, Milford, McDonald-Maier, T-RO 2019): network, regions, method.

The network is Caffe's AlexNet-Places365 up to conv3 (Zhou et al., TPAMI 2018), after its published
prototxt: the vocabulary of the authors holds activations of this network. docs/methods.md says how
to convert both files. The AlexNet that Places365 publishes for PyTorch is another network, for
which there is no vocabulary.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..channels.channel import View, picture_of
from ..files import naming, parse_npy, read_bytes, requiring
from .vectors import VectorMethod
from .weights import fill, find_weights, random_network, read_checkpoint

CHANNELS = 384
"""Channels of conv3, the length of a word."""

_SIDE = 227
_MEAN_BGR = (104.051, 112.514, 116.676)
"""Mean pixel of ``places365CNN_mean.binaryproto``."""

_WEIGHTS, _WORDS = ("alexnet_places365.caffemodel.pt",), ("region_vlad_vocabulary.npy",)
_CONVERTED = "{}, and converted as docs/methods.md says"
_PLACES365 = _CONVERTED.format("the Places365 project (github.com/CSAILVision/places365)")
_AUTHORS = _CONVERTED.format("the authors (github.com/Ahmedest61/CNN-Region-VLAD-VPR)")


class RegionVLAD(VectorMethod):
    """VLAD of an image's regions over a vocabulary, compared by the cosine.

    ``regions`` and ``words`` are N and V of the paper: 400 and 256, or 200 and 128. Weights are a
    PyTorch file with the layers by Caffe's names, from ``conv1.weight`` to ``conv3.bias``; the
    vocabulary is a ``.npy`` file ``(words, 384)``. `find_weights` finds both. Random ones, which
    the name then tells, are for the cost of the method. It needs the extra ``eval``.
    """

    needs = frozenset({"images", "weights"})

    def __init__(
        self,
        weights: str | Path | None = None,
        vocabulary: str | Path | None = None,
        random_weights: bool = False,
        regions: int = 400,
        words: int = 256,
    ) -> None:
        self.name = "region-vlad (random weights)" if random_weights else "region-vlad"
        if random_weights:
            network = random_network(AlexNetPlaces365)
            random = torch.Generator().manual_seed(0)
            self._words = torch.rand(words, CHANNELS, generator=random)
        else:
            path, network = find_weights(weights, _WEIGHTS, _PLACES365), AlexNetPlaces365().eval()
            fill(network, read_checkpoint(path), path)
            self._words = read_vocabulary(find_weights(vocabulary, _WORDS, _AUTHORS), words)
        self._network, self._regions = network, regions
        self.length = self._words.numel()

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        described = []
        for view in views:
            pixels = torch.tensor(picture_of(view, self.name)).permute(2, 0, 1)
            regions = region_descriptors(self._network(pixels[None])[0], self._regions)
            described.append(vlad(regions, self._words))
        return torch.stack(described)


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
        self.conv3 = nn.Conv2d(256, CHANNELS, 3, padding=1)
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


def region_descriptors(maps: Tensor, count: int) -> Tensor:
    """The aggregated descriptors ``(R, C)`` float32 of the at most ``count`` regions with the
    highest energy, by falling energy, of activations ``(C, H, W)`` float that are not negative.

    A region is a set of 8-connected places of one map with the same integer part of the activation,
    not 0, as in the authors' program; the paper groups activations that are not zero. Its energy is
    its mean activation, its descriptor the sum of the values of all maps over its bounding box. Of
    equal energies the earlier map comes first, then the upper, then the left region.
    """
    with requiring("eval", "region-vlad needs"):
        from skimage.measure import label
    levels = maps.numpy(force=True).astype(np.int64)
    apart = np.arange(len(levels))[:, None, None] * (levels.max(initial=0) + 1)  # maps do not join
    levels = np.where(levels > 0, levels + apart, 0)
    numbers, regions = label(levels, return_num=True, connectivity=3)  # in the order of the regions
    channel, y, x = (maps >= 1).nonzero(as_tuple=True)
    number = torch.from_numpy(numbers - 1)[channel, y, x]
    size = torch.zeros(regions, dtype=torch.float64)
    energy = torch.zeros_like(size).index_add_(0, number, maps[channel, y, x].double())
    energy /= size.index_add_(0, number, torch.ones_like(energy)[number])
    best = energy.sort(descending=True, stable=True).indices[:count]
    top, bottom, left, right = (
        number.new_zeros(regions).scatter_reduce(0, number, edge, way, include_self=False)[best]
        for edge, way in ((y, "amin"), (y, "amax"), (x, "amin"), (x, "amax"))
    )
    sums = F.pad(maps.double().cumsum(1).cumsum(2), (1, 0, 1, 0))
    boxes = sums[:, bottom + 1, right + 1] + sums[:, top, left]
    boxes -= sums[:, top, right + 1] + sums[:, bottom + 1, left]
    return boxes.mT.float()


def vlad(descriptors: Tensor, words: Tensor) -> Tensor:
    """Vector of locally aggregated descriptors (Jegou et al., CVPR 2010) with signed square root.
    ``(R, D)`` descriptors and ``(V, D)`` words give ``(V * D,)`` float of length 1, or zeros if
    there are no descriptors."""
    nearest = torch.cdist(descriptors, words).argmin(1)
    residuals = torch.zeros_like(words).index_add_(0, nearest, descriptors - words[nearest])
    rooted = residuals.sign() * residuals.abs().sqrt()
    return F.normalize(rooted.flatten(), dim=0)


def read_vocabulary(path: Path, words: int) -> Tensor:
    """The vocabulary ``(words, 384)`` float32 in a ``.npy`` file; another file is a ValueError."""
    with naming(f"{path}: expected a vocabulary in a .npy file, see docs/methods.md"):
        array = parse_npy(read_bytes(path))
    numbers = array.dtype.kind in "iuf"
    if array.shape != (words, CHANNELS) or not numbers or not np.isfinite(array).all():
        expected = f"must hold a vocabulary ({words}, {CHANNELS}) of finite numbers"
        raise ValueError(f"{path} {expected}, got {array.shape} {array.dtype}")
    return torch.from_numpy(array.astype(np.float32))
