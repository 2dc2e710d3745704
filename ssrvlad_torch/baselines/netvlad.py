"""NetVLAD (Arandjelovic, Gronat, Torii, Pajdla, Sivic, CVPR 2016) as a method."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from ..recognition.matching import cosines
from .netvlad_network import NetVLADNetwork
from .netvlad_weights import read_netvlad_weights
from .protocol import Frame, Image, image_of
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


class NetVLAD:
    """Descriptors of a trained network, compared by their cosine.

    Images keep their own size, as in the authors' programs.

    Args:
        weights: a file in a form of `read_netvlad_weights`, or a folder with one under its
            published name; None looks in ``~/.cache/ssrvlad/weights``.
        random_weights: only to measure what the method costs; the name then says so.
        device: where the network runs.

    Raises:
        FileNotFoundError: there are no weights; the message says where to get them.
        ValueError: the weights are damaged or do not fit.
    """

    needs = frozenset({"images", "weights"})

    def __init__(
        self,
        weights: str | Path | None = None,
        random_weights: bool = False,
        device: str = "cpu",
    ) -> None:
        self.name = "netvlad (random weights)" if random_weights else "netvlad"
        network = random_network(NetVLADNetwork) if random_weights else _trained(weights)
        self._network = network.to(device)
        self._device = device

    def encode_query(self, frames: Iterable[Frame]) -> Tensor:
        """``(N, 4096)`` float32 of length 1; without whitening ``(N, 32768)``."""
        rows = [self._encode(image_of(frame, self.name)) for frame in frames]
        return torch.stack(rows) if rows else torch.empty(0, self._network.size)

    encode_reference = encode_query

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return cosines(queries, references)

    @torch.no_grad()
    def _encode(self, image: Image) -> Tensor:
        if min(image.shape[:2]) < _SMALLEST:
            raise ValueError(
                f"method {self.name} needs images of at least {_SMALLEST} x {_SMALLEST} pixels, "
                f"got {image.shape[0]} x {image.shape[1]}"
            )
        pixels = torch.tensor(image, device=self._device).permute(2, 0, 1)
        descriptor: Tensor = self._network(pixels[None])[0]
        return descriptor.cpu()


def _trained(weights: str | Path | None) -> NetVLADNetwork:
    path = find_weights(weights, _FILES, _ORIGIN)
    state = read_netvlad_weights(path)
    clusters = len(state["pool.centroids"]) if "pool.centroids" in state else 64
    outputs = len(state["whiten.bias"]) if "whiten.bias" in state else None
    with torch.device("meta"):
        network = NetVLADNetwork(clusters=clusters, outputs=outputs)
    fill(network, state, path)
    return network.eval()
