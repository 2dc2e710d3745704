"""The trivial method for label maps: how much of each category there is in each cell of a grid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..recognition.matching import cosines
from ..stages.layers import categorise, category_table, refuse_unknown
from ..taxonomy import CATEGORIES, label_space
from .protocol import Frame, batches, label_kind, labels_of

_BATCH = 16


class LabelGrid:
    """Square roots of the categories' fractions in the cells of a grid, normalised.

    Where the grid does not divide the image, neighbouring cells share pixels. Pixels of no
    category count in a cell's size. Label maps are read as SSR-VLAD reads them, so descriptors
    of different label spaces compare.

    Args:
        rows, columns: of the grid. With 6 x 10 a descriptor has 480 numbers, as SSR-VLAD's.

    Raises:
        ValueError: fewer than one row or column.
    """

    name = "label-grid"
    needs = frozenset({"labels"})

    def __init__(self, rows: int = 6, columns: int = 10) -> None:
        if rows < 1 or columns < 1:
            raise ValueError(
                f"method label-grid wants a grid of 1 x 1 or more, got {rows} x {columns}"
            )
        self.rows, self.columns = rows, columns

    def encode_query(self, frames: Iterable[Frame]) -> Tensor:
        """``(Q, 8 * rows * columns)`` float32 of length 1, or zero for an empty image."""
        return self._encode(frames)

    def encode_reference(self, frames: Iterable[Frame]) -> Tensor:
        """``(R, 8 * rows * columns)``, as queries are encoded."""
        return self._encode(frames)

    def scores(self, queries: Tensor, references: Tensor) -> Tensor:
        """Cosines."""
        return cosines(queries, references)

    @torch.no_grad()
    def _encode(self, frames: Iterable[Frame]) -> Tensor:
        described = map(self._describe, batches(frames, _BATCH, label_kind))
        return torch.cat([torch.zeros(0, len(CATEGORIES) * self.rows * self.columns), *described])

    def _describe(self, frames: Sequence[Frame]) -> Tensor:
        maps, spaces = zip(*(labels_of(frame, self.name) for frame in frames), strict=True)
        labels, space = torch.from_numpy(np.stack(maps)), label_space(spaces[0])
        categories = categorise(labels, *category_table(space))
        refuse_unknown(labels, categories, space)
        layers = categories[:, None] == torch.arange(len(CATEGORIES))[:, None, None]
        fractions = F.adaptive_avg_pool2d(layers.float(), (self.rows, self.columns))
        return F.normalize(fractions.sqrt().flatten(1), dim=1)
