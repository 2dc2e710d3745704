"""Features of a segmentation network as a method, see `stages.features`."""

from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from ..recognition.signs import SignQueries, SignRows
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..stages.features import SHAPE
from ..taxonomy import LabelSpace
from .dense_network import segmenter_of
from .protocol import Frame, batches, image_of, image_shape

_BATCH = 4


class EncoderFeatures:
    """Signs of what the encoder of a segmentation network sees in each cell of a grid. The network
    is given, or its name, see `open_network`, with the label space of its classes, if neither they
    nor its YAML file say it. No network is a FileNotFoundError, one without features is a
    ValueError."""

    name = "features"
    needs = frozenset({"images", "weights"})

    def __init__(
        self, network: Segmenter | str | Path | None = None, labels_as: str | LabelSpace = AUTO
    ) -> None:
        self._segmenter = segmenter_of(network, self.name, labels_as)

    def encode_query(self, frames: Iterable[Frame]) -> Tensor:
        """``(Q, *SHAPE)`` uint8."""
        found = [torch.zeros(0, *SHAPE, dtype=torch.uint8)]
        for batch in batches(frames, _BATCH, image_shape):
            pictures = [image_of(frame, self.name) for frame in batch]
            said = self._segmenter.segment(pictures, features=True)
            found += [torch.from_numpy(each.features)[None] for each in said]
        return torch.cat(found)

    def encode_reference(self, frames: Iterable[Frame]) -> Tensor:
        """``(R, *SHAPE)``, encoded as queries are."""
        return self.encode_query(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines of the best move, see `SignQueries`."""
        return SignQueries(queries, SignRows(references)).scores()
