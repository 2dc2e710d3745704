"""Column: how the descriptors of a channel are stored."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor


class Column(NamedTuple):
    """The column of a database that holds the descriptors of a channel.

    Attributes:
        name: of the channel.
        fingerprint: descriptors are comparable only if their fingerprints are equal; empty if they
            are custom.
        shape: of the descriptor of a frame.
        dtype: ``"float32"``, or ``"uint8"`` for signs, eight in a byte.
    """

    name: str
    fingerprint: str
    shape: tuple[int, ...]
    dtype: Literal["float32", "uint8"] = "float32"

    def zeros(self, frames: int) -> Tensor:
        """Zeros ``(N, *shape)`` of `dtype`, for the descriptors of N frames."""
        return torch.zeros(frames, *self.shape, dtype=getattr(torch, self.dtype))
