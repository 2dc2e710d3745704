"""Segmentation networks for methods: by their names, and with two outputs for LoST-X."""

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace

DenseNetwork = Callable[[Tensor], tuple[Tensor, Tensor]]
"""``(1, H, W, 3)`` uint8 RGB -> ``(1, D, h, w)`` features and, at any resolution, ``(1, C, h',
w')`` probabilities, both float; channel c is of id c of a label space."""


def segmenter_of(
    network: Segmenter | str | Path | None, method: str, labels_as: str | LabelSpace = AUTO
) -> Segmenter:
    """A method's segmentation network, given or by its name; none is a FileNotFoundError."""
    if network is None:
        raise FileNotFoundError(
            f"no network: {method} needs a segmentation network, by the setting network"
        )
    return network if isinstance(network, Segmenter) else Segmenter.load(network, labels_as)


def dense_network(segmenter: Segmenter) -> DenseNetwork:
    """A segmentation network with one of its activations, the finest of `find_activations`, and a
    softmax behind it; no such activation, or several by name, are a ValueError."""
    names = segmenter.features.names  # of an ONNX graph, outputs only now
    names = names if segmenter.config.features else names[:1]
    if len(names) != 1:
        raise ValueError(f"features: expected one activation for LoST-X, got {', '.join(names)}")

    def run(pictures: Tensor) -> tuple[Tensor, Tensor]:
        scores, [features] = segmenter.labels.run(pictures, names)
        if not scores.is_floating_point():
            raise ValueError("method lost-x: the network gives ids, expected class scores")
        return features.float().cpu(), scores.float().softmax(dim=1).cpu()

    return run
