"""Metrics of place recognition, exact: a threshold at every distinct score, ties together.

The convention is the one named ``exact``: the positives are the queries that have a true match.
A query is accepted at a threshold if its best score reaches it. An accepted query is a true
positive if its best candidate is a true match, else a false positive, also where it has no true
match at all. So recall is TP / positives, and a query without a true match can only cost
precision.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Truth = Sequence[npt.NDArray[np.int64]]
"""For each query the rows of the references that are true matches, possibly none."""


@dataclass(frozen=True)
class PrecisionRecall:
    """Precision and recall at every distinct score, the highest threshold first.

    Attributes:
        precision, recall, thresholds: ``(T,)`` float64.
    """

    precision: Floats
    recall: Floats
    thresholds: Floats

    @property
    def auc(self) -> float:
        """Area under the curve by the trapezoid rule, from recall 0 at the first precision.

        NaN without positives. Recall that the method never reaches adds no area.
        """
        if len(self.precision) == 0 or np.isnan(self.recall).any():
            return 0.0 if len(self.precision) == 0 else float("nan")
        recall = np.concatenate(([0.0], self.recall))
        precision = np.concatenate((self.precision[:1], self.precision))
        return float(np.diff(recall) @ (precision[1:] + precision[:-1]) / 2)

    @property
    def recall_at_full_precision(self) -> float:
        """Recall@100%Precision: the largest recall at which every accepted query is right."""
        perfect = self.recall[self.precision == 1.0]
        return float(perfect.max()) if len(perfect) else 0.0


def recall_rate(indices: npt.NDArray[np.int64], truth: Truth, n: int) -> float:
    """RecallRate@N: share of the queries with a true match that have one among their first N.

    Args:
        indices: ``(Q, top)`` candidates, best first, -1 for none.
        truth: true matches of each query.
        n: candidates looked at, at most ``top``.

    Returns:
        0 to 1; NaN if no query has a true match.

    Raises:
        ValueError: ``n`` is below 1, fewer candidates than ``n`` were kept, or the numbers of
            queries differ.
    """
    _check_queries(indices, truth)
    if n < 1:
        raise ValueError(f"the N of RecallRate@N must be at least 1, got {n}")
    if n > indices.shape[1]:
        raise ValueError(f"RecallRate@{n} needs {n} candidates a query, got {indices.shape[1]}")
    hits = [
        bool(np.isin(row[:n], matches).any())
        for row, matches in zip(indices, truth, strict=True)
        if len(matches)
    ]
    return float(np.mean(hits)) if hits else float("nan")


def precision_recall(
    scores: Floats, correct: npt.NDArray[np.bool_], positives: int
) -> PrecisionRecall:
    """Precision and recall of accepting each query's best candidate.

    Args:
        scores: ``(Q,)`` score of the best candidate, -inf for a query that has none.
        correct: ``(Q,)`` whether that candidate is a true match.
        positives: number of queries that have a true match.

    Returns:
        the curve; empty if no query has a candidate, with NaN recall if there are no positives.
    """
    candidates = np.isfinite(scores)
    order = np.argsort(-scores[candidates], kind="stable")
    ranked, right = scores[candidates][order], correct[candidates][order]
    last_of_tie = np.flatnonzero(np.diff(ranked, append=-np.inf) != 0)
    accepted = last_of_tie + 1
    true_positives = np.cumsum(right)[last_of_tie] if len(right) else np.zeros(0)
    recall = true_positives / positives if positives else np.full(len(accepted), np.nan)
    return PrecisionRecall(true_positives / accepted, recall, ranked[last_of_tie])


def evaluate(
    scores: npt.NDArray[np.floating[Any]],
    indices: npt.NDArray[np.int64],
    truth: Truth,
    at: Iterable[int] = (1, 5, 10),
) -> dict[str, Any]:
    """RecallRate@N, AUC-PR and Recall@100%Precision of the candidates of a set of queries.

    Args:
        scores, indices: ``(Q, top)`` from `ssrvlad_torch.match`, as arrays.
        truth: true matches of each query.
        at: the N of RecallRate@N, at most ``top``.

    Returns:
        ``recall_at`` by N as text, ``auc_pr``, ``recall_at_100_precision``, ``queries`` and
        ``queries_with_match``. A figure that has no meaning (no positives) is NaN.
    """
    _check_queries(indices, truth)
    positives = sum(len(matches) > 0 for matches in truth)
    first = zip(indices[:, 0], truth, strict=True)
    correct = np.array([index in matches for index, matches in first], bool)
    curve = precision_recall(scores[:, 0].astype(np.float64), correct, positives)
    return {
        "recall_at": {str(n): recall_rate(indices, truth, n) for n in at},
        "auc_pr": curve.auc if positives else float("nan"),
        "recall_at_100_precision": curve.recall_at_full_precision if positives else float("nan"),
        "queries": len(indices),
        "queries_with_match": positives,
    }


def _check_queries(indices: npt.NDArray[np.int64], truth: Truth) -> None:
    if indices.ndim != 2 or len(indices) != len(truth):
        raise ValueError(
            f"wanted (Q, top) candidates for {len(truth)} queries, got {indices.shape}"
        )
