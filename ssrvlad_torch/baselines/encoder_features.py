"""Features of a segmentation network as a method, see `stages.features`."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..channels.channel import PICTURE, View, picture_of
from ..channels.features import Features
from ..recognition.recognise import references_of
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .vectors import ChannelMethod


def segmenter_of(
    network: Segmenter | str | Path | None, method: str, labels_as: str | LabelSpace = AUTO
) -> Segmenter:
    """A method's segmentation network, given or by its name; none is a FileNotFoundError."""
    if network is None:
        raise FileNotFoundError(
            f"no network: {method} needs a segmentation network, by the setting network"
        )
    return network if isinstance(network, Segmenter) else Segmenter.load(network, labels_as)


class EncoderFeatures(ChannelMethod):
    """Encoder activations of a segmentation network, binarised in each cell of a grid. The network
    is given, or its name, see `open_network`, with the label space of its classes unless they or
    its YAML file define it. No network is a FileNotFoundError, one without features a
    ValueError."""

    name, shape, dtype, trust = Features.name, Features.shape, Features.dtype, Features.trust
    needs = frozenset({PICTURE, "weights"})
    _batch = 4

    def __init__(
        self, network: Segmenter | str | Path | None = None, labels_as: str | LabelSpace = AUTO
    ) -> None:
        self._segmenter = segmenter_of(network, self.name, labels_as)

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        pictures = [picture_of(view, self.name) for view in views]
        segmented = self._segmenter.segment(pictures, features=True)
        return torch.cat([torch.from_numpy(labels.features)[None] for labels in segmented])

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines of the best move, see `channels.signs`."""
        town = references_of({self.name: references}, [""] * len(references))
        scores, _ = town.compare({self.name: queries.numpy()}, sweep=True)
        return torch.from_numpy(scores)
