"""Scores of pairs, as many at a time as are wanted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..outcomes import Bools, Rows

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
        here, empty_here = _directions(queries, rows)
        there, empty_there = _directions(references, columns)
        cosines: npt.NDArray[np.float32] = (here @ there.T).numpy()
        cosines[empty_here] = -np.inf
        cosines[:, empty_there] = -np.inf
        return cosines

    return scores


def _directions(vectors: Tensor, rows: Rows) -> tuple[Tensor, Bools]:
    """Some vectors at length 1, and which of them are zero."""
    chosen = vectors[torch.from_numpy(rows)].float()
    norms = torch.linalg.vector_norm(chosen, dim=1, keepdim=True)
    return chosen / torch.where(norms > 0, norms, 1), (norms == 0)[:, 0].numpy()


def stored_scores(similarity: npt.NDArray[np.floating[Any]]) -> Scores:
    """Scores that are there already, ``(Q, R)``."""
    return lambda rows, columns: similarity[np.ix_(rows, columns)]
