"""Methods that are channels: their encodings are vectors, compared by their cosine."""

from collections.abc import Iterable

import torch
from torch import Tensor

from ..channels.channel import View, batches
from ..channels.hog import HOG
from ..channels.vectors import VectorChannel
from ..recognition.sweep import score


class VectorMethod(VectorChannel):
    """A channel of vectors as a method: queries and references are described alike, in batches."""

    _batch = 16

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, length)`` float32 of length 1, or zero for an empty frame."""
        vectors = map(self.describe, batches(frames, self._batch))
        return torch.cat([torch.zeros(0, self.length), *vectors])

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, length)``, encoded as queries are."""
        return self.encode_query(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return score(queries, references)


class HOGMethod(VectorMethod, HOG):
    """HOG as a method."""
