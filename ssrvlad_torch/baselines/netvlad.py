"""NetVLAD (Arandjelovic, Gronat, Torii, Pajdla, Sivic, CVPR 2016) as a method."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..channels.channel import View, picture_of
from .netvlad_network import NetVLADNetwork
from .netvlad_weights import read_netvlad_weights
from .vectors import VectorMethod
from .weights import fill, find_weights, random_network

_FILES = (
    "vd16_pitts30k_conv5_3_vlad_preL2_intra_white.mat",
    "Pitts30K_struct.mat",
    "VGG16-NetVLAD-Pitts30K.mat",
    "vgg16_netvlad_checkpoint/checkpoints/model_best.pth.tar",
    "vgg16_netvlad_checkpoint/checkpoints/checkpoint.pth.tar",
)
_ORIGIN = (
    "the NetVLAD project page (www.di.ens.fr/willow/research/netvlad), by hloc, "
    "and by github.com/Nanne/pytorch-NetVlad"
)
_SMALLEST = 16


class NetVLAD(VectorMethod):
    """Descriptors of a trained network, compared by their cosine.

    Images keep their own size, as in the authors' programs. A descriptor has 4096 numbers; without
    whitening, 32768. Weights are a file for `read_netvlad_weights`, found by `find_weights`. Random
    ones, which the name then tells, are for the cost of the method.
    """

    needs = frozenset({"images", "weights"})
    _batch = 1

    def __init__(
        self,
        weights: str | Path | None = None,
        random_weights: bool = False,
        device: str = "cpu",
    ) -> None:
        self.name = "netvlad (random weights)" if random_weights else "netvlad"
        if random_weights:
            network = random_network(NetVLADNetwork)
        else:
            path = find_weights(weights, _FILES, _ORIGIN)
            state = read_netvlad_weights(path)
            clusters = len(state["pool.centroids"]) if "pool.centroids" in state else 64
            outputs = len(state["whiten.bias"]) if "whiten.bias" in state else None
            with torch.device("meta"):
                network = NetVLADNetwork(clusters=clusters, outputs=outputs).eval()
            fill(network, state, path)
        self._network, self.length = network.to(device), network.size
        self._device = device

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        image = picture_of(views[0], self.name)
        if min(image.shape[:2]) < _SMALLEST:
            raise ValueError(
                f"method {self.name} needs images of at least {_SMALLEST} x {_SMALLEST} pixels, "
                f"got {image.shape[0]} x {image.shape[1]}"
            )
        pixels = torch.tensor(image, device=self._device).permute(2, 0, 1)
        descriptor: Tensor = self._network(pixels[None])
        return descriptor.cpu()
