"""The outcome of each query: its best candidate, the score, and whether the candidate is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Scores: TypeAlias = "Tensor | npt.NDArray[np.floating[Any]]"
Indices: TypeAlias = "Tensor | Rows"
Truth = Sequence[Rows]
"""Rows of the references that are true matches of each query, possibly none."""


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of the queries, in their order, each ``(Q,)``.

    Attributes:
        score: float64, score of the best candidate, -inf without a candidate.
        candidate: int64, row of the best candidate, -1 without a candidate.
        correct: bool, whether the best candidate is a true match.
        has_match: bool, whether the query has a true match.
        rank: int64, rank from 1 of the first true match among the candidates, 0 without one.
    """

    score: Floats
    candidate: Rows
    correct: Bools
    has_match: Bools
    rank: Rows

    def __len__(self) -> int:
        return len(self.score)

    @property
    def wrong(self) -> Bools:
        """Whether the best candidate is no true match; false without a candidate."""
        return ~self.correct & (self.candidate >= 0)


def judge(scores: Scores, indices: Indices, truth: Truth) -> Outcomes:
    """Compares the candidates of each query, ``(Q, top)`` scores, best first, and int64 rows, with
    its true matches. Other shapes, NaN, +inf, and a matrix as ``truth`` are a ValueError."""
    scores, indices = as_array(scores), as_array(indices)
    if isinstance(truth, np.ndarray) or any(np.asarray(rows).dtype == bool for rows in truth):
        raise ValueError(
            "expected the rows of the true matches of each query, got a matrix; they are "
            "[np.flatnonzero(row) for row in matrix]"
        )
    if indices.ndim != 2 or len(indices) != len(truth):
        raise ValueError(
            f"expected (Q, top) candidates for {len(truth)} queries, got {indices.shape}"
        )
    if scores.shape != indices.shape or indices.shape[1] == 0:
        raise ValueError(
            "expected scores and indices of one shape (Q, top) with top >= 1, "
            f"got {scores.shape} and {indices.shape}"
        )
    bad = int((np.isnan(scores) | (scores == np.inf)).any(axis=1).sum())
    if bad:
        raise ValueError(f"{bad} of {len(scores)} queries have scores that are NaN or +inf")
    if ((scores > -np.inf) & (indices < 0)).any():
        raise ValueError("a candidate has a score but no row; expected -inf for an index of -1")
    hits = np.zeros(indices.shape, bool)
    for row, matches in enumerate(truth):
        hits[row] = np.isin(indices[row], matches)
    hits &= indices >= 0
    return Outcomes(
        score=scores[:, 0].astype(np.float64),
        candidate=indices[:, 0].astype(np.int64),
        correct=hits[:, 0],
        has_match=np.array([len(matches) > 0 for matches in truth], bool),
        rank=np.where(hits.any(axis=1), hits.argmax(axis=1) + 1, 0).astype(np.int64),
    )


def as_array(values: Tensor | npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A tensor of any device as an array."""
    detached = getattr(values, "detach", None)
    return np.asarray(detached().cpu() if detached else values)
