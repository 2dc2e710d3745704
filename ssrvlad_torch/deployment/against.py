"""Against: compares a network's ONNX file with the network in PyTorch, at several sizes."""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..files import naming, one_line
from ..segmentation.features import probed
from ..segmentation.label_network import LabelNetwork
from ..segmentation.network_outputs import tensors_of
from ..segmentation.networks import NamedNetwork, open_network
from ..segmentation.onnx_network import OnnxNetwork
from ..segmentation.preparation import SegmenterConfig
from ..taxonomy import DYNAMIC, LabelClass, LabelSpace, label_space
from .differences import LABELS, MAX_OTHER_PIXELS
from .fuse import network_in
from .golden import photograph

SIZES = ((128, 128), (256, 384), (512, 768))
"""Height and width of the pictures on which networks are compared."""

_BYTES = SegmenterConfig(white=255, mean=(0, 0, 0), std=(1, 1, 1), output=LABELS)
"""The settings of a fused file, which prepares its pictures itself."""


class SizeCheck(NamedTuple):
    """The comparison at one size: height and width of the picture and of the network's input; the
    fraction of pixels with another label, NaN if the file gives none; what is wrong, or ``""``."""

    size: tuple[int, int]
    fed: tuple[int, int]
    other_labels: float
    problem: str = ""


@torch.inference_mode()
def verify_against(file: str | Path, network: str) -> list[SizeCheck]:
    """Compares the label maps of an ONNX file, of a network or of `fuse`, with those of the network
    in PyTorch of which it was made, on a drawn picture of each of `SIZES` that it takes. If only
    one of the two has settings, they prepare the pictures of both. Names or files that cannot be
    compared are a ValueError, a missing extra is an ImportError."""
    graph, module = open_network(file), open_network(network)
    if not isinstance(graph.network, OnnxNetwork):
        raise ValueError(f"{file} is no ONNX file; expected the one to compare with {network}")
    if isinstance(module.network, OnnxNetwork):
        raise ValueError(f"{network} is an ONNX file; expected the network in PyTorch")
    plain, fused = SegmenterConfig(), network_in(graph.network.metadata)
    of_file = SegmenterConfig.of(fused.settings) if fused else graph.config
    settings = module.config
    if settings == plain:  # outputs of the two forms have other names
        settings = replace(of_file, output=None, features=None)
    elif of_file == plain:
        of_file = replace(settings, output=None, features=None)
    space = _channels(module, settings)
    exported = LabelNetwork(graph.network, space, _BYTES if fused else of_file)
    if settings.size is None and not fused:
        settings = replace(settings, size=exported.config.size)  # that the graph requires
    original, checks, reason = LabelNetwork(module.network, space, settings), [], ""
    for size in SIZES:
        picture = torch.from_numpy(photograph(np.random.default_rng(0), *size))[None]
        try:
            expected = original(picture).cpu()
        except Exception as error:  # networks raise many kinds of errors
            reason = one_line(error)
            continue
        fraction, problem = math.nan, ""
        try:
            fraction = float((exported(picture).cpu() != expected).double().mean())
        except Exception as error:  # runtimes too
            problem = f"the file fails: {one_line(error)}"
        if fraction > MAX_OTHER_PIXELS:
            problem = "other labels"
        checks.append(SizeCheck(size, settings.network_size(*size), fraction, problem))
    if not checks:
        raise ValueError(f"{network} takes none of the sizes: {reason}")
    return checks


def _channels(module: NamedNetwork, config: SegmenterConfig) -> LabelSpace:
    """Classes for the channels of a network, without names; for ids, those of a byte."""
    first, last = config.classes or (0, 0)
    count = last - first
    if not count:
        prepared = LabelNetwork(module.network, label_space("cityscapes-trainids"), config)
        with naming(module.name):
            tensors = tensors_of(module.network(probed(prepared)[0]))
        name = next(n for n in (str(config.output), "out", "logits", *tensors) if n in tensors)
        scores = tensors[name]
        count = scores.shape[1] if scores.ndim == 4 and scores.is_floating_point() else 256
    classes = (LabelClass(number, str(number), DYNAMIC, None) for number in range(count))
    return LabelSpace("channels", "the network's output", tuple(classes))
