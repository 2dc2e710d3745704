"""Methods that are channels: queries and references are described alike, in batches."""

from collections.abc import Iterable

import torch
from torch import Tensor

from ..channels.channel import Channel, VectorChannel, View, batches
from ..channels.hog import HOG
from ..recognition.sweep import score


class ChannelMethod(Channel):
    """A channel as a method; encodings are its descriptors."""

    _batch = 16

    @torch.no_grad()
    def encode_query(self, frames: Iterable[View]) -> Tensor:
        """``(Q, *shape)``."""
        described = map(self.describe, batches(frames, self._batch))
        return torch.cat(
            [torch.zeros(0, *self.shape, dtype=getattr(torch, self.dtype)), *described]
        )

    def encode_reference(self, frames: Iterable[View]) -> Tensor:
        """``(R, *shape)``, encoded as queries are."""
        return self.encode_query(frames)


class VectorMethod(ChannelMethod, VectorChannel):
    """A channel of vectors as a method: of length 1, or zero for an empty frame."""

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return score(queries, references)


class HOGMethod(VectorMethod, HOG):
    """HOG as a method."""
