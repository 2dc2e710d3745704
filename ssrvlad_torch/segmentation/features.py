"""The features of a network as a descriptor of pictures, made in the pass that labels them."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from ..files import one_line
from ..stages.features import COLUMNS, ROWS, SIGNS, Features
from .activations import find_activations
from .label_network import LabelNetwork
from .onnx_network import OnnxNetwork

PROBES = ((224, 448), (512, 512), (512, 1024), (1024, 2048), (96, 128))
"""Sizes of pictures that are tried until the network takes one."""

_REVISION = 1


class NetworkFeatures(nn.Module):
    """What a network, which ``labels`` runs, sees in pictures, as signs; see `stages.features`.

    The activations are those of the rule of `find_activations` or of the setting ``features``; a
    network without them is a ValueError. An ONNX graph gives them as outputs afterwards.

    Attributes:
        names: of the activations, in the order that `forward` takes.
        key: in hex, of the digest of the network, see `identity.digest_of`, its settings, the
            activations and the form of the signs.
        fingerprint: a text under which a database stores the signs.
    """

    def __init__(self, labels: LabelNetwork, digest: str) -> None:
        super().__init__()
        numbers = probed(labels)
        self.activations = find_activations(labels.network, numbers, labels.config.features)
        self.names = [each.name for each in self.activations]
        self.signs = Features([each.shape[1] for each in self.activations])
        if isinstance(labels.network, OnnxNetwork):
            labels.network.take(self.names)
        settings = dataclasses.asdict(labels.config)
        for name in ("output", "classes", "features"):  # activations do not depend on them
            del settings[name]
        content = [_REVISION, digest, settings, self.names, ROWS, COLUMNS, SIGNS]
        self.key = hashlib.blake2b(json.dumps(content).encode(), digest_size=8).hexdigest()
        form = f"{ROWS} x {COLUMNS} cells, {SIGNS} signs"
        self.fingerprint = f"{form} of {', '.join(self.names)}, {self.key}"

    def forward(self, activations: Sequence[Tensor]) -> Tensor:
        """``(B, *SHAPE)`` uint8, the signs of the activations of pictures."""
        signs: Tensor = self.signs.to(activations[0].device)(*activations)
        return signs


@torch.inference_mode()
def probed(labels: LabelNetwork) -> Tensor:
    """The input of the network for a picture of the first of `PROBES` that it takes; a ValueError
    if it takes none."""
    reason = ValueError("takes no picture")
    for height, width in PROBES:
        probe = np.random.default_rng(0).integers(0, 256, (1, height, width, 3), np.uint8)
        try:
            numbers = labels.numbers(torch.from_numpy(probe))
            labels.network(numbers)
        except Exception as error:  # networks raise many kinds of errors
            reason = ValueError(f"the network fails at {height}x{width}: {one_line(error)}")
            continue
        return numbers
    raise reason
