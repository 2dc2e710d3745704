"""Base classes of methods whose encodings are vectors, compared by their cosine."""

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from ..recognition.sweep import score
from .protocol import Frame, batches


class VectorMethod:
    """A method that encodes queries and references alike, in batches of frames of one kind. A
    subclass defines `name`, `length` and `_describe`, the vectors of a batch."""

    name: str
    length: int
    _batch = 16
    _kind: Callable[[Frame], object] | None = None
    """A value that is equal for all frames of a batch."""

    @torch.no_grad()
    def encode_query(self, frames: Iterable[Frame]) -> Tensor:
        """``(Q, length)`` float32 of length 1, or zero for an empty frame."""
        vectors = map(self._describe, batches(frames, self._batch, self._kind))
        return torch.cat([torch.zeros(0, self.length), *vectors])

    def encode_reference(self, frames: Iterable[Frame]) -> Tensor:
        """``(R, length)``, encoded as queries are."""
        return self.encode_query(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """``(Q, R)`` cosines."""
        return score(queries, references)

    def _describe(self, frames: Sequence[Frame]) -> Tensor:
        raise NotImplementedError


class GridMethod(VectorMethod):
    """A method with eight numbers in each cell of a grid over the frame; with 6 x 10 cells a
    descriptor has 480, as SSR-VLAD's. Fewer than one row or column is a ValueError. ``mirrored``
    gives the vectors ``(..., length)`` of mirrored frames, by those of the frames."""

    def __init__(self, rows: int = 6, columns: int = 10) -> None:
        if rows < 1 or columns < 1:
            raise ValueError(
                f"method {self.name}: the grid must be 1 x 1 or more, got {rows} x {columns}"
            )
        self.rows, self.columns, self.length = rows, columns, 8 * rows * columns
