"""The features of a network as a descriptor of pictures, made in the pass that labels them.

The projections of `stages.features` come from what the network sees in a few pictures of pink
noise, whose spectrum is that of photographs. They are made of fixed numbers, so no data set is
needed, and the same network has the same projections everywhere."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from ..files import one_line
from ..stages.features import COLUMNS, FORM, ROWS, SIGNS, Features, cell_means, random_numbers
from .activations import find_activations
from .label_network import LabelNetwork
from .onnx_network import OnnxNetwork

PROBES = ((224, 448), (512, 512), (512, 1024), (1024, 2048), (96, 128))
"""Sizes of pictures that are tried until the network takes one."""

NOISE = 4
"""Pictures of noise that the network sees."""

_REVISION = 3
_GRAY, _CONTRAST = 128, 48
_NOISE_BITS = 24


class NetworkFeatures(nn.Module):
    """What a network, which ``labels`` runs, sees in pictures, as signs of the activations
    ``names``; a network without them is a ValueError. ``size`` is that of the pictures of noise,
    ``key`` a digest of all that makes the signs, ``fingerprint`` the text under which a database
    stores them."""

    def __init__(self, labels: LabelNetwork, digest: str) -> None:
        super().__init__()
        numbers, *self.size = probed(labels)
        self.activations = find_activations(labels.network, numbers, labels.config.features)
        self.names = [act.name for act in self.activations]
        if isinstance(labels.network, OnnxNetwork):
            labels.network.take(self.names)
        self.signs = Features(*noise_means(labels, self.names, *self.size))
        settings = dataclasses.asdict(labels.config)
        for name in ("output", "classes", "features"):  # activations do not depend on them
            del settings[name]
        content = [_REVISION, digest, settings, self.names, self.size, NOISE, ROWS, COLUMNS, SIGNS]
        self.key = hashlib.blake2b(json.dumps(content).encode(), digest_size=8).hexdigest()
        self.fingerprint = f"{FORM} of {', '.join(self.names)}, {self.key}"

    def forward(self, activations: Sequence[Tensor]) -> Tensor:
        """``(B, *SHAPE)`` uint8, the signs of the activations of pictures."""
        signs: Tensor = self.signs.to(activations[0].device)(*activations)
        return signs


def pink_noise(number: int, height: int, width: int) -> npt.NDArray[np.uint8]:
    """The picture of noise of a number from 0, ``(height, width, 3)`` uint8: amplitudes fall with
    the frequency, and no two of its colours are alike."""
    size = (3, height, width)
    drawn = random_numbers(3 * height * width, number * 3 * height * width)
    white = (drawn >> np.uint64(64 - _NOISE_BITS)).astype(np.float64).reshape(size)
    down, across = np.fft.fftfreq(height, 1 / height), np.fft.rfftfreq(width, 1 / width)
    frequency = np.hypot(down[:, None], across)
    frequency[0, 0] = np.inf  # no mean
    pink = np.fft.irfft2(np.fft.rfft2(white) / frequency, size[1:])
    scaled = _GRAY + _CONTRAST * pink / pink.std((1, 2), keepdims=True)
    picture: npt.NDArray[np.uint8] = scaled.round().clip(0, 255).astype(np.uint8)
    return picture.transpose(1, 2, 0)


@torch.inference_mode()
def noise_means(
    labels: LabelNetwork, names: Sequence[str], height: int, width: int
) -> list[Tensor]:
    """For each of the activations `cell_means` ``(NOISE, C, ROWS, COLUMNS)`` of pictures of noise,
    which the network takes one by one."""
    means = []
    for number in range(NOISE):
        picture = torch.from_numpy(pink_noise(number, height, width))
        _, activations = labels.run(picture[None], names)
        means.append([cell_means(values).cpu() for values in activations])
    return [torch.cat(level) for level in zip(*means, strict=True)]


@torch.inference_mode()
def probed(labels: LabelNetwork) -> tuple[Tensor, int, int]:
    """The network's input for a picture of the first of `PROBES` that it takes, and that size."""
    reason = ValueError("takes no picture")
    for height, width in PROBES:
        try:
            numbers = labels.numbers(torch.from_numpy(pink_noise(0, height, width))[None])
            labels.network(numbers)
        except Exception as error:  # networks raise many kinds of errors
            reason = ValueError(f"the network fails at {height}x{width}: {one_line(error)}")
            continue
        return numbers, height, width
    raise reason
