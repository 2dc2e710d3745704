"""Scores of pairs, a block at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ...recognition.sweep import score
from ..outcomes import Rows

Scores = Callable[[Rows, Rows], npt.NDArray[np.floating[Any]]]
"""From rows of n queries and of m references to the ``(n, m)`` scores of all their pairs, -inf
where there can be no match."""


def cosine_scores(queries: Tensor, references: Tensor) -> Scores:
    """Cosines of descriptors, -inf where one is zero: what is empty matches nothing.

    Args:
        queries: ``(Q, D)`` float.
        references: ``(R, D)`` float.
    """

    def scores(rows: Rows, columns: Rows) -> npt.NDArray[np.float32]:
        some = score(queries[torch.from_numpy(rows)], references[torch.from_numpy(columns)])
        found: npt.NDArray[np.float32] = some.numpy()
        return found

    return scores


def stored_scores(similarity: npt.NDArray[np.floating[Any]]) -> Scores:
    """Scores that are there already, ``(Q, R)``."""
    return lambda rows, columns: similarity[np.ix_(rows, columns)]
