"""The trivial method for label maps: the fraction of each category in each cell of a grid."""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..channels.channel import LABELS, View, labels_of
from ..stages.layers import UNKNOWN, categorise, category_table, refuse_unknown
from ..taxonomy import CATEGORIES, label_space
from .vectors import VectorMethod


class LabelGrid(VectorMethod):
    """Square roots of the categories' fractions in the cells of a grid, normalised.

    If the grid does not divide the image, neighbouring cells share pixels. Pixels of no category
    count in a cell's size. Label maps are read as SSR-VLAD reads them, so descriptors of different
    label spaces are comparable.
    """

    name = "label-grid"
    needs = frozenset({LABELS})

    def __init__(self, rows: int = 6, columns: int = 10) -> None:
        if rows < 1 or columns < 1:
            raise ValueError(f"label-grid: the grid must be 1 x 1 or more, got {rows} x {columns}")
        self.rows, self.columns, self.length = rows, columns, len(CATEGORIES) * rows * columns
        self.fingerprint = f"{rows} x {columns} cells"

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        maps, spaces = zip(*(labels_of(view, self.name) for view in views), strict=True)
        labels, space = torch.from_numpy(np.stack(maps)), label_space(spaces[0])
        categories = categorise(labels, *category_table(space))
        if bool((categories == UNKNOWN).any()):
            refuse_unknown(labels, space)
        layers = categories[:, None] == torch.arange(len(CATEGORIES))[:, None, None]
        fractions = F.adaptive_avg_pool2d(layers.float(), (self.rows, self.columns))
        return F.normalize(fractions.sqrt().flatten(1), dim=1)
