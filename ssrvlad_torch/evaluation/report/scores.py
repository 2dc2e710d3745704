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
    """Cosines of descriptors ``(Q, D)`` and ``(R, D)``, -inf where one is zero: what is empty
    matches nothing."""
    return lambda rows, columns: score(
        queries[torch.from_numpy(rows)], references[torch.from_numpy(columns)]
    ).numpy()


def stored_scores(similarity: npt.NDArray[np.floating[Any]]) -> Scores:
    """Scores that are there already, ``(Q, R)``."""
    return lambda rows, columns: similarity[np.ix_(rows, columns)]
