"""Published weights of NetVLAD, in all their file formats, as one dictionary of tensors."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .matconvnet import read_matconvnet
from .netvlad_network import IMAGENET_MEAN, IMAGENET_STD
from .weights import read_checkpoint

_MATLAB = b"MATLAB"
_VGG = ("1_1", "1_2", "2_1", "2_2", "3_1", "3_2", "3_3", "4_1", "4_2", "4_3", "5_1", "5_2", "5_3")
_POSITIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Numbers of the convolutions conv1_1 to conv5_3 in torchvision's ``vgg16().features``."""


def read_netvlad_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a published NetVLAD, named as in `NetVLADNetwork`; another or a damaged file
    is a ValueError. The first bytes of a file show its family.

    MATLAB: the authors' ``vd16_*_conv5_3_vlad_preL2_intra_white.mat``, as published or with its
    objects turned into structs (``net_class2struct.m`` of netvlad_tf_open, the ``*_struct.mat`` of
    hloc). Input is RGB minus the average image. It includes PCA whitening.

    PyTorch: the checkpoint of pytorch-NetVlad (``encoder.N``, ``pool.conv``, ``pool.centroids``),
    and the same with ``WPCA.0`` (Patch-NetVLAD). Input is scaled as torchvision does.
    """
    with path.open("rb") as file:
        if file.read(len(_MATLAB)) == _MATLAB:
            return _from_matlab(path)
    state = read_checkpoint(path)
    state["mean"], state["std"] = 255 * torch.tensor((IMAGENET_MEAN, IMAGENET_STD))
    if "pool.centroids" in state:  # VLAD version 1 of the port has no biases b_k: they are 0
        state.setdefault("pool.conv.bias", torch.zeros(len(state["pool.centroids"])))
    if "WPCA.0.weight" in state:
        state["whiten.weight"] = state["WPCA.0.weight"].flatten(1)
        state["whiten.bias"] = state["WPCA.0.bias"]
    return state


def _from_matlab(path: Path) -> dict[str, Tensor]:
    weights, average = read_matconvnet(path)
    names = [*(f"conv{name}" for name in _VGG), "vlad:core"]
    missing = [name for name in names if len(weights.get(name, ())) != 2]
    if missing:
        raise ValueError(f"{path} lacks weights of the layer {missing[0]}; it has {[*weights]}")
    assign, minus_centres = (w.reshape(w.shape[-2:]).T for w in weights["vlad:core"])
    state = {
        "mean": average,
        "std": np.ones(3, np.float32),
        "pool.conv.weight": assign[:, :, None, None],
        "pool.conv.bias": np.zeros(len(assign), np.float32),
        "pool.centroids": -minus_centres,
    }
    for position, name in zip(_POSITIONS, _VGG, strict=True):
        kernel, bias = weights[f"conv{name}"]
        state[f"encoder.{position}.weight"] = kernel.transpose(3, 2, 0, 1)
        state[f"encoder.{position}.bias"] = bias.ravel()
    if "WPCA" in weights:
        matrix, bias = weights["WPCA"]
        outputs = matrix.shape[-1]  # MATLAB's vectors are ordered by channel, ours by centre
        by_centre = matrix.reshape(-1, len(assign), outputs).transpose(2, 1, 0)
        state["whiten.weight"] = by_centre.reshape(outputs, -1)
        state["whiten.bias"] = bias.ravel()
    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in state.items()}
