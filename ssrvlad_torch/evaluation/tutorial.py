"""The curve of "Visual Place Recognition: A Tutorial": all pairs, linearly spaced thresholds.

Schubert, Neubert, Garg, Milford and Fischer, IEEE Robotics & Automation Magazine 2024 (arXiv
2303.03281), and the code that comes with it. Written anew from its description. There the
references are the rows of the similarity matrix; here they are the columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .curves import PrecisionRecall
from .outcomes import Bools, Floats, Truth, refuse_nan

STEPS = 100
MATCHINGS = ("multi", "single")


@dataclass(frozen=True)
class PairCounts:
    """What is accepted of each query at each threshold.

    Attributes:
        accepted, right: ``(Q, T)`` float64, counts of pairs, and of true matches among them.
        positives: ``(Q,)`` float64, what there is to be found.
        thresholds: ``(T,)`` float64, falling.
    """

    accepted: Floats
    right: Floats
    positives: Floats
    thresholds: Floats

    def curve(self, weights: Floats) -> PrecisionRecall:
        """The curve with each query counted ``weights`` ``(..., Q)`` times."""
        return PrecisionRecall(
            accepted=weights @ self.accepted,
            true_positives=weights @ self.right,
            positives=weights @ self.positives,
            thresholds=self.thresholds,
            start=1.0,
        )


def count_pairs(
    similarity: npt.NDArray[np.floating[Any]],
    truth: Truth,
    matching: str = "multi",
    soft: Truth | None = None,
) -> PairCounts:
    """Counts pairs over `STEPS` thresholds, linearly spaced from the highest similarity to the
    lowest.

    A pair to be ignored gets the lowest similarity, as the tutorial does it. The thresholds are
    float64 whatever the similarity is.

    Args:
        similarity: ``(Q, R)``; -inf for a pair that cannot match is ignored likewise.
        truth: true matches of each query, the tutorial's ``GThard``.
        matching: ``multi``: every pair is accepted or not, the positives are all true pairs;
            ``single``: only the best reference of each query, the positives are the queries that
            have a true match.
        soft: matches of each query that are neither right nor wrong, the tutorial's ``GTsoft``;
            those that are also in ``truth`` are true matches.

    Returns:
        the counts, without any threshold if there is no finite similarity.

    Raises:
        ValueError: the shapes do not fit, a similarity is NaN or +inf, or ``matching`` is
            neither.
    """
    if matching not in MATCHINGS:
        raise ValueError(f"matching must be one of {', '.join(MATCHINGS)}, got {matching!r}")
    if similarity.ndim != 2 or len(similarity) != len(truth):
        raise ValueError(
            f"expected a (Q, R) similarity matrix for {len(truth)} queries, got {similarity.shape}"
        )
    refuse_nan(similarity, "similarities")
    true = truth_matrix(truth, similarity.shape[1])
    if not np.isfinite(similarity).any():
        none = np.zeros((len(truth), 0))
        return PairCounts(none, none, _positives(true, matching), np.zeros(0))
    pairs = similarity.astype(np.float64)
    ignored = np.isneginf(pairs)
    if soft is not None:
        ignored |= truth_matrix(soft, similarity.shape[1]) & ~true
    pairs[ignored] = pairs[np.isfinite(pairs)].min()
    positives = _positives(true, matching)
    if matching == "single":
        best = pairs.argmax(axis=1)[:, None]
        pairs = np.take_along_axis(pairs, best, 1)
        true = np.take_along_axis(true, best, 1)
    thresholds = np.linspace(pairs.max(), pairs.min(), STEPS)
    accepted, right = _cumulate(pairs, true, thresholds)
    return PairCounts(accepted, right, positives, thresholds)


def truth_matrix(truth: Truth, references: int) -> Bools:
    """Ground truth as a matrix ``(Q, references)`` bool."""
    matrix = np.zeros((len(truth), references), bool)
    for row, matches in enumerate(truth):
        matrix[row, matches] = True
    return matrix


def _positives(true: Bools, matching: str) -> Floats:
    return np.array(true.any(axis=1) if matching == "single" else true.sum(axis=1), np.float64)


def _cumulate(pairs: Floats, true: Bools, thresholds: Floats) -> tuple[Floats, Floats]:
    """How many pairs, and true ones, of each row reach each of the falling thresholds."""
    steps = len(thresholds)
    accepted, right = np.zeros((2, len(pairs), steps))
    rising = thresholds[::-1]
    for row, (scores, matches) in enumerate(zip(pairs, true, strict=True)):
        first = steps - np.searchsorted(rising, scores, side="right")
        accepted[row] = np.bincount(first, minlength=steps).cumsum()
        right[row] = np.bincount(first[matches], minlength=steps).cumsum()
    return accepted, right
