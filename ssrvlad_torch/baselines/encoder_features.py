"""Features of a segmentation network as a method, see `stages.features`."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..channels.channel import PICTURE, View, batches, picture_of
from ..channels.features import Features
from ..recognition.comparison import ReferenceRows
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..stages.features import SHAPE
from ..taxonomy import LabelSpace
from .dense_network import segmenter_of

_BATCH = 4


class EncoderFeatures:
    """Encoder activations of a segmentation network, binarised in each cell of a grid. The network
    is given, or its name, see `open_network`, with the label space of its classes unless they or
    its YAML file define it. No network is a FileNotFoundError, one without features a
    ValueError."""

    name, trust = Features.name, Features.trust
    needs = frozenset({PICTURE, "weights"})

    def __init__(
        self, network: Segmenter | str | Path | None = None, labels_as: str | LabelSpace = AUTO
    ) -> None:
        self._segmenter = segmenter_of(network, self.name, labels_as)

    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, *SHAPE)`` uint8."""
        signs = [torch.zeros(0, *SHAPE, dtype=torch.uint8)]
        for batch in batches(frames, _BATCH):
            pictures = [picture_of(view, self.name) for view in batch]
            segmented = self._segmenter.segment(pictures, features=True)
            signs += [torch.from_numpy(labels.features)[None] for labels in segmented]
        return torch.cat(signs)

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, *SHAPE)``, encoded as queries are."""
        return self.encode_query(frames)

    def references(
        self, stored: Tensor, sequences: Sequence[str], means: Tensor | None = None
    ) -> ReferenceRows:
        """See `Channel`."""
        return ReferenceRows(stored, sequences, means)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines of the best move, see `channels.signs`."""
        known = self.references(references, [""] * len(references))
        return known.compare(queries, False, True).whole()
