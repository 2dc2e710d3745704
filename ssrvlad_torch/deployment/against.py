"""Against: compares a network's ONNX file with the network in PyTorch, at several sizes.

A graph that is right at the size at which it was traced can be wrong at others: what Python
computes of a size while it is traced becomes a constant. Comparing files with files misses that.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..encoding.results import Progress, do_nothing
from ..files import naming, one_line, parse_json
from ..segmentation.features import probed
from ..segmentation.label_network import LabelNetwork
from ..segmentation.network_outputs import tensors_of
from ..segmentation.networks import AUTO, NamedNetwork, open_network
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.preparation import SegmenterConfig
from ..taxonomy import DYNAMIC, LabelClass, LabelSpace, label_space
from .fuse import LABELS, MAX_OTHER_PIXELS, NETWORK
from .golden import photograph

SIZES = ((128, 128), (256, 384), (512, 768))
"""Height and width of the pictures on which networks are compared."""

_BYTES = SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1), output=LABELS)
"""The settings of a fused file, which prepares its pictures itself."""

_IDS = 256


class SizeCheck(NamedTuple):
    """The comparison at one size.

    Attributes:
        size: height and width of the picture.
        fed: height and width of the network's input for it.
        others: fraction of the pixels with another label, 0 to 1; NaN if one gives no labels.
        problem: what is wrong, or ``""``.
        compared: whether the network in PyTorch takes this size.
    """

    size: tuple[int, int]
    fed: tuple[int, int]
    others: float
    problem: str = ""
    compared: bool = True


@torch.inference_mode()
def verify_against(
    file: str | Path, network: str, progress: Progress = do_nothing
) -> list[SizeCheck]:
    """Compares the label maps of an ONNX file with those of the network that it was made of, on a
    drawn picture of each of `SIZES`.

    Where only one of the two has settings, they prepare the pictures of both.

    Args:
        file: a network's ONNX file, a YAML file that names one, or a file of ``ssrvlad fuse``.
        network: the name of the network in PyTorch, see `open_network`.
        progress: called with 1 for each size.

    Raises:
        ValueError: the file is no ONNX graph, the network is one, a name or a setting is not
            understood, or the network takes none of the sizes.
        ImportError: an extra is not installed.
    """
    graph, module = open_network(file), open_network(network)
    if not isinstance(graph.network, OnnxNetwork):
        raise ValueError(f"{file} is no ONNX file; expected the one to compare with {network}")
    if isinstance(module.network, OnnxNetwork):
        raise ValueError(f"{network} is an ONNX file; expected the network in PyTorch")
    exported, original = _prepared(graph, module)
    checks = []
    for size in SIZES:
        checks.append(_check(exported, original, size))
        progress(1)
    if not any(check.compared for check in checks):
        raise ValueError(f"{network} takes none of the sizes: {checks[-1].problem}")
    return checks


def _prepared(graph: NamedNetwork, module: NamedNetwork) -> tuple[LabelNetwork, LabelNetwork]:
    """Both with the settings of their own, or of the other; of a fused file the settings are those
    of the network in it."""
    assert isinstance(graph.network, OnnxNetwork)
    own = module.config if module.config != SegmenterConfig() else None
    given, text = graph.config, graph.network.metadata.get(NETWORK)
    fused = SegmenterConfig.of(parse_json(text, NETWORK)["settings"]) if text else None
    if fused:
        given = _BYTES
    elif given == SegmenterConfig() and own:
        given = _without_names(own)
    space = _space(graph, module, own or fused or given)
    exported = LabelNetwork(graph.network, space, given)
    settings = own or _without_names(fused or exported.config)
    return exported, LabelNetwork(module.network, space, settings)


def _check(exported: LabelNetwork, original: LabelNetwork, size: tuple[int, int]) -> SizeCheck:
    picture, fed = _picture(*size), original.config.network_size(*size)
    try:
        expected = original(picture).cpu()
    except Exception as error:  # networks raise many kinds of errors
        problem = f"the network in PyTorch fails: {one_line(error)}"
        return SizeCheck(size, fed, math.nan, problem, compared=False)
    try:
        got = exported(picture).cpu()
    except Exception as error:  # so do runtimes
        return SizeCheck(size, fed, math.nan, f"the file fails: {one_line(error)}")
    others = float((got != expected).double().mean())
    return SizeCheck(size, fed, others, "other labels" if others > MAX_OTHER_PIXELS else "")


def _picture(height: int, width: int) -> Tensor:
    return torch.from_numpy(photograph(np.random.default_rng(0), height, width))[None]


def _without_names(config: SegmenterConfig) -> SegmenterConfig:
    """Settings for another form of the network, whose outputs have other names."""
    return replace(config, output=None, features=None)


def _space(graph: NamedNetwork, module: NamedNetwork, config: SegmenterConfig) -> LabelSpace:
    """The label space of a network, or else classes for its channels, without names."""
    for named in (module, graph):
        if named.labels_as not in (None, AUTO):
            return label_space(str(named.labels_as))
    first, last = config.classes or (0, 0)
    names = module.class_names or graph.class_names
    count = last - first or max(names, default=-1) + 1 or _channels(module, config)
    classes = (LabelClass(number, str(number), DYNAMIC, None) for number in range(count))
    return LabelSpace("channels", "the network's output", tuple(classes))


def _channels(module: NamedNetwork, config: SegmenterConfig) -> int:
    """The channels of the class scores of a network, as many as ids of bytes if it gives ids."""
    prepared = LabelNetwork(module.network, label_space("cityscapes-trainids"), config)
    with naming(module.name):
        tensors = tensors_of(module.network(probed(prepared)[0]))
    names = (str(config.output), "out", "logits", *tensors)
    scores = [tensors[n] for n in names if n in tensors and tensors[n].ndim == 4]
    return scores[0].shape[1] if scores and scores[0].is_floating_point() else _IDS
