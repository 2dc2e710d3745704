"""NetVLAD (Arandjelovic, Gronat, Torii, Pajdla, Sivic, CVPR 2016): the network and the method.

VGG-16 is configuration D of Simonyan and Zisserman, ICLR 2015; the layer is that of Section 3.1.
Weights are those of the PyTorch port, github.com/Nanne/pytorch-NetVlad.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..channels.channel import View, picture_of
from .vectors import VectorMethod
from .weights import fill, find_weights, random_network, read_checkpoint

WIDTHS = (64, 128, 256, 512, 512)
"""Channels of each of the five blocks of VGG-16."""

_DEPTHS = (2, 2, 3, 3, 3)
_FILES = (
    "vgg16_netvlad_checkpoint/checkpoints/model_best.pth.tar",
    "vgg16_netvlad_checkpoint/checkpoints/checkpoint.pth.tar",
)
_ORIGIN = "github.com/Nanne/pytorch-NetVlad"
_SMALLEST = 16


class NetVLAD(VectorMethod):
    """Descriptors of a trained network, compared by their cosine.

    Images keep their own size, as in the authors' programs. A descriptor has 32768 numbers; with
    the whitening ``WPCA.0`` of Patch-NetVLAD's checkpoints 4096. Weights are a file of the PyTorch
    port, see `read_netvlad`, found by `find_weights`. Random ones, which the name then tells, are
    for the cost of the method, with whitening.
    """

    needs = frozenset({"images", "weights"})
    _batch = 1

    def __init__(self, weights: str | Path | None = None, random_weights: bool = False) -> None:
        self.name = "netvlad (random weights)" if random_weights else "netvlad"
        if random_weights:
            network = random_network(NetVLADNetwork)
        else:
            network = read_netvlad(find_weights(weights, _FILES, _ORIGIN))
        self._network, self.length = network, network.size

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        [view] = views
        image = picture_of(view, self.name)
        if min(image.shape[:2]) < _SMALLEST:
            raise ValueError(
                f"method {self.name} needs images of at least {_SMALLEST} x {_SMALLEST} pixels, "
                f"got {image.shape[0]} x {image.shape[1]}"
            )
        descriptor: Tensor = self._network(torch.tensor(image).permute(2, 0, 1)[None])
        return descriptor


class NetVLADNetwork(nn.Module):
    """VGG-16 up to conv5_3, the NetVLAD layer with K ``clusters``, and PCA whitening to ``outputs``
    numbers, if not None. ``(B, 3, H, W)`` RGB from 0 to 255, uint8 or float, sides of at least 16,
    give ``(B, size)`` of length 1; ``size`` is ``outputs``, or ``clusters * widths[-1]``. Input is
    scaled as torchvision does."""

    mean: Tensor
    std: Tensor

    def __init__(
        self, widths: Sequence[int] = WIDTHS, clusters: int = 64, outputs: int | None = 4096
    ) -> None:
        super().__init__()
        for name, values in (("mean", (0.485, 0.456, 0.406)), ("std", (0.229, 0.224, 0.225))):
            scale = 255 * torch.tensor(values, device="cpu")
            self.register_buffer(name, scale[:, None, None], persistent=False)
        self.encoder = vgg16(widths)
        self.pool = NetVLADLayer(clusters, widths[-1])
        size = clusters * widths[-1]
        self.whiten = None if outputs is None else nn.Linear(size, outputs)
        self.size = outputs or size

    def forward(self, images: Tensor) -> Tensor:
        """The descriptor of each image."""
        vlad: Tensor = self.pool(self.encoder((images - self.mean) / self.std))
        return vlad if self.whiten is None else F.normalize(self.whiten(vlad), dim=1)


class NetVLADLayer(nn.Module):
    """Residuals to learnt centres, summed with soft assignment: ``(B, D, H, W)`` float give ``(B,
    K * D)`` of length 1, centre by centre. Parameters are named as in the port: ``conv`` holds w_k
    and b_k of Eq. 3, ``centroids`` c_k."""

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


def vgg16(widths: Sequence[int] = WIDTHS) -> nn.Sequential:
    """The thirteen convolutions up to conv5_3, without its ReLU and without the last pooling, as in
    the authors' network and its port; layers have the numbers of torchvision's
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


def read_netvlad(path: Path, widths: Sequence[int] = WIDTHS) -> NetVLADNetwork:
    """The network of a checkpoint of the port: ``encoder.N``, ``pool.conv``, ``pool.centroids``,
    and ``WPCA.0`` if it is whitened. Another or a damaged file is a ValueError."""
    state = read_checkpoint(path)
    clusters = len(state.get("pool.centroids", torch.empty(64)))
    # VLAD version 1 of the port has no biases b_k: they are 0
    state.setdefault("pool.conv.bias", torch.zeros(clusters))
    outputs = None
    if "WPCA.0.weight" in state:
        state["whiten.weight"] = state["WPCA.0.weight"].flatten(1)
        outputs = len(state["whiten.weight"])
    if "WPCA.0.bias" in state:
        state["whiten.bias"] = state["WPCA.0.bias"]
    with torch.device("meta"):
        network = NetVLADNetwork(widths, clusters, outputs).eval()
    fill(network, state, path)
    return network
