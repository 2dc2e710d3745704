"""NetVLAD (Arandjelovic, Gronat, Torii, Pajdla, Sivic, CVPR 2016) on VGG-16 (Simonyan and
Zisserman, ICLR 2015), with the weights that the PyTorch port publishes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from kornia.enhance import normalize
from torch import Tensor, nn

from ..channels.channel import View, picture_of
from ..files import naming
from .channel_methods import VectorMethod
from .weights import fill, find_weights

_WIDTHS, _DEPTHS = (64, 128, 256, 512, 512), (2, 2, 3, 3, 3)
_MEAN, _STD = torch.tensor((0.485, 0.456, 0.406)), torch.tensor((0.229, 0.224, 0.225))
_FILES = [f"vgg16_netvlad_checkpoint/checkpoints/{n}.pth.tar" for n in ("model_best", "checkpoint")]


class NetVLAD(VectorMethod):
    """A trained network's descriptors, compared by their cosine; 32768 numbers, or 4096 with the
    whitening ``WPCA.0`` of Patch-NetVLAD. Pictures keep their size."""

    name = "netvlad"
    needs = frozenset({"images", "weights"})
    batch = 1

    def __init__(self, weights: str | Path | None = None) -> None:
        file = find_weights(weights, _FILES, "github.com/Nanne/pytorch-NetVlad")
        self._network = read_netvlad(file)
        self.shape = (self._network.length,)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        [view] = views
        picture = torch.tensor(picture_of(view, self.name)).permute(2, 0, 1)
        if min(picture.shape[1:]) < 16:
            size = "at least 16 x 16 pixels, got {} x {}".format(*picture.shape[1:])
            raise ValueError(f"method {self.name} needs images of {size}")
        descriptor: Tensor = self._network(picture[None])
        return descriptor


class NetVLADNetwork(nn.Module):
    """VGG-16 up to conv5_3, without its ReLU; the NetVLAD layer; whitening to ``outputs`` numbers,
    if not None. ``(B, 3, H, W)`` RGB from 0 to 255, sides of at least 16, give ``(B, length)`` of
    length 1. Parameters are named as in the port."""

    def __init__(
        self, widths: Sequence[int] = _WIDTHS, clusters: int = 64, outputs: int | None = 4096
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, width, depth in zip((3, *widths[:-1]), widths, _DEPTHS, strict=True):
            for channels in (before, *[width] * (depth - 1)):
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
            layers.append(nn.MaxPool2d(2))
        self.encoder = nn.Sequential(*layers[:-2])
        self.pool = NetVLADLayer(clusters, widths[-1])
        self.length = outputs or clusters * widths[-1]
        self.WPCA = nn.Sequential(nn.Conv2d(clusters * widths[-1], outputs, 1)) if outputs else None

    def forward(self, images: Tensor) -> Tensor:
        """The descriptor of each image."""
        scaled = normalize(images.to(self.pool.centroids) / 255, _MEAN, _STD)
        vlad: Tensor = self.pool(self.encoder(scaled))
        return F.normalize(self.WPCA(vlad[..., None, None]).flatten(1)) if self.WPCA else vlad


class NetVLADLayer(nn.Module):
    """``(B, D, H, W)`` float give ``(B, K * D)`` of length 1, centre by centre (Section 3.1)."""

    def __init__(self, clusters: int, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, clusters, 1)
        self.centroids = nn.Parameter(torch.rand(clusters, channels))

    def forward(self, maps: Tensor) -> Tensor:
        """See the class."""
        x = F.normalize(maps, dim=1)
        assignment = self.conv(x).flatten(2).softmax(dim=1)  # Eq. 3
        residuals = assignment @ x.flatten(2).mT  # Eq. 4
        residuals -= assignment.sum(dim=2)[..., None] * self.centroids
        return F.normalize(F.normalize(residuals, dim=2).flatten(1), dim=1)


def read_netvlad(path: Path, widths: Sequence[int] = _WIDTHS) -> NetVLADNetwork:
    """The network of a checkpoint of the port; another or a damaged file is a ValueError."""
    state = read_checkpoint(path)
    clusters = len(state.get("pool.centroids", torch.empty(64)))
    state.setdefault("pool.conv.bias", torch.zeros(clusters))  # VLAD version 1 of the port has none
    whitening = state.get("WPCA.0.weight")
    with torch.device("meta"):
        network = NetVLADNetwork(widths, clusters, None if whitening is None else len(whitening))
    fill(network, state, path)
    return network.eval()


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a PyTorch checkpoint, bare or under ``state_dict``, without the ``module.`` of
    ``nn.DataParallel``; anything else is a ValueError."""
    scalar = np.float64(0).__reduce__()[0]  # under NumPy's old and new modules
    numbers: list[Any] = [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    kinds = (np.float32, np.float64, np.int32, np.int64, bool)
    numbers += [np.dtype, *(type(np.dtype(kind)) for kind in kinds)]
    unpickled = torch.serialization.safe_globals(numbers)
    with naming(f"{path} is not a whole PyTorch checkpoint"), unpickled:
        content = torch.load(path, map_location="cpu", weights_only=True)
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    pairs = state.items() if isinstance(state, dict) else ()
    tensors = {str(k).replace("module.", ""): v for k, v in pairs if isinstance(v, Tensor)}
    if not tensors:
        raise ValueError(f"{path} must hold tensors by name, bare or under state_dict; it has none")
    return tensors
