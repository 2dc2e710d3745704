"""The curve of "Visual Place Recognition: A Tutorial": all pairs, linearly spaced thresholds.

Schubert et al., RAM 2024 (arXiv 2303.03281), and its code, reimplemented from the description. In
the tutorial the references are the rows of the similarity matrix; here they are the columns.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .curves import PrecisionRecall
from .outcomes import Floats, Truth, check_finite

STEPS = 100


@dataclass(frozen=True)
class PairCounts:
    """Counts of pairs of each query at each threshold, accepted ones and true matches among them
    ``(Q, T)``; those that can be found ``(Q,)``; decreasing thresholds ``(T,)``; all float64."""

    accepted: Floats
    right: Floats
    positives: Floats
    thresholds: Floats

    def curve(self, weights: Floats) -> PrecisionRecall:
        """The curve; ``weights`` ``(..., Q)`` are the counts of the queries."""
        return PrecisionRecall(
            accepted=weights @ self.accepted,
            true_positives=weights @ self.right,
            positives=weights @ self.positives,
            thresholds=self.thresholds,
            start=1.0,
        )


def count_pairs(
    similarity: npt.NDArray[np.floating[Any]], truth: Truth, single: bool = False
) -> PairCounts:
    """Counts pairs of a similarity ``(Q, R)`` at `STEPS` thresholds, linearly spaced from the
    highest finite similarity to the lowest; without a finite similarity there are no thresholds. A
    pair that cannot match has -inf and gets the lowest similarity, as in the tutorial.

    With ``single``, only the best reference of each query is counted, and the positives are the
    queries with a true match; otherwise all pairs and all true pairs. Shapes that do not fit, and a
    similarity that is NaN or +inf, are a ValueError.
    """
    if similarity.ndim != 2 or len(similarity) != len(truth):
        raise ValueError(
            f"expected a (Q, R) similarity matrix for {len(truth)} queries, got {similarity.shape}"
        )
    check_finite(similarity, "similarities")
    true = np.zeros(similarity.shape, bool)
    for row, matches in enumerate(truth):
        true[row, matches] = True
    positives = np.array(true.any(axis=1) if single else true.sum(axis=1), np.float64)
    if not np.isfinite(similarity).any():
        empty = np.zeros((len(truth), 0))
        return PairCounts(empty, empty, positives, np.zeros(0))
    pairs = similarity.astype(np.float64)
    pairs[np.isneginf(pairs)] = pairs[np.isfinite(pairs)].min()
    if single:
        best = pairs.argmax(axis=1)[:, None]
        pairs = np.take_along_axis(pairs, best, 1)
        true = np.take_along_axis(true, best, 1)
    thresholds = np.linspace(pairs.max(), pairs.min(), STEPS)
    accepted, right = np.zeros((2, len(pairs), STEPS))
    for row, (scores, matches) in enumerate(zip(pairs, true, strict=True)):
        first = STEPS - np.searchsorted(thresholds[::-1], scores, side="right")
        accepted[row] = np.bincount(first, minlength=STEPS).cumsum()
        right[row] = np.bincount(first[matches], minlength=STEPS).cumsum()
    return PairCounts(accepted, right, positives, thresholds)
