"""The trivial method for label maps: the fraction of each category in each cell of a grid."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..stages.layers import UNKNOWN, categorise, category_table, refuse_unknown
from ..taxonomy import CATEGORIES, label_space
from .protocol import Frame, label_kind, labels_of
from .vectors import GridMethod


class LabelGrid(GridMethod):
    """Square roots of the categories' fractions in the cells of a grid, normalised.

    If the grid does not divide the image, neighbouring cells share pixels. Pixels of no category
    count in a cell's size. Label maps are read as SSR-VLAD reads them, so descriptors of different
    label spaces are comparable.
    """

    name = "label-grid"
    needs = frozenset({"labels"})
    _kind = staticmethod(label_kind)

    def _describe(self, frames: Sequence[Frame]) -> Tensor:
        maps, spaces = zip(*(labels_of(frame, self.name) for frame in frames), strict=True)
        labels, space = torch.from_numpy(np.stack(maps)), label_space(spaces[0])
        categories = categorise(labels, *category_table(space))
        if bool((categories == UNKNOWN).any()):
            refuse_unknown(labels, space)
        layers = categories[:, None] == torch.arange(len(CATEGORIES))[:, None, None]
        fractions = F.adaptive_avg_pool2d(layers.float(), (self.rows, self.columns))
        return F.normalize(fractions.sqrt().flatten(1), dim=1)

    def mirrored(self, vectors: Tensor) -> Tensor:
        """See `GridMethod`; exact."""
        rows: Tensor = vectors.unflatten(-1, (-1, self.columns))
        return rows.flip(-1).flatten(-2)
