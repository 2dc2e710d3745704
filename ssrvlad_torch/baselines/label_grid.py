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

ROWS, COLUMNS = 6, 10


class LabelGrid(VectorMethod):
    """Square roots of the categories' fractions in the cells of a grid of 6 x 10, normalised.

    If the grid does not divide the image, neighbouring cells share pixels. Pixels of no category
    count in a cell's size. Label maps are read as SSR-VLAD reads them, so descriptors of different
    label spaces are comparable.
    """

    name, length = "label-grid", len(CATEGORIES) * ROWS * COLUMNS
    needs = frozenset({LABELS})

    def describe(self, views: Sequence[View], _columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        maps, spaces = zip(*(labels_of(view, self.name) for view in views), strict=True)
        labels, space = torch.from_numpy(np.stack(maps)), label_space(spaces[0])
        categories = categorise(labels, *category_table(space))
        if bool((categories == UNKNOWN).any()):
            refuse_unknown(labels, space)
        layers = categories[:, None] == torch.arange(len(CATEGORIES))[:, None, None]
        fractions = F.adaptive_avg_pool2d(layers.float(), (ROWS, COLUMNS))
        return F.normalize(fractions.sqrt().flatten(1), dim=1)
