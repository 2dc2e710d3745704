"""What became of each query, and precision and recall over thresholds, with the figures that
summarise a curve. Counts may have a leading axis of resamples; every figure then has it too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
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
    its true matches. Scores that are NaN or +inf are a ValueError."""
    scores, indices = as_array(scores), as_array(indices)
    bad = int((np.isnan(scores) | (scores == np.inf)).any(axis=1).sum())
    if bad:
        raise ValueError(f"{bad} of {len(scores)} queries have scores that are NaN or +inf")
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


@dataclass(frozen=True)
class PrecisionRecall:
    """Counts at each threshold, the highest first: ``accepted`` and ``true_positives`` ``(..., T)``
    float64, ``thresholds`` ``(T,)``, and ``positives`` ``(...)``, the number that could be found;
    where it is 0, figures are NaN. ``start`` is the precision at recall 0, or ``None`` for that at
    the highest threshold that accepts anything."""

    accepted: Floats
    true_positives: Floats
    positives: Floats
    thresholds: Floats
    start: float | None = None

    @cached_property
    def precision(self) -> Floats:
        """Precision ``(..., T)``; where nothing is accepted, the precision at recall 0."""
        fraction = self.true_positives / np.maximum(self.accepted, 1)
        return np.where(self.accepted > 0, fraction, self._at_recall_zero[..., None])

    @cached_property
    def recall(self) -> Floats:
        """Recall ``(..., T)``."""
        return _divide(self.true_positives, self.positives[..., None])

    @property
    def auc(self) -> Floats:
        """AUC-PR, the area by the trapezoid rule, from recall 0 to the highest reached."""
        precision = np.concatenate((self._at_recall_zero[..., None], self.precision), axis=-1)
        heights = (precision[..., 1:] + precision[..., :-1]) / 2
        return _divide((self._added * heights).sum(axis=-1), self.positives)

    @property
    def average_precision(self) -> Floats:
        """The mean precision over thresholds, by the recall that each adds, as scikit-learn's."""
        return _divide((self._added * self.precision).sum(axis=-1), self.positives)

    @property
    def recall_at_full_precision(self) -> Floats:
        """Recall@100%Precision: the highest recall at which all accepted candidates are right."""
        perfect = np.where(self.precision == 1.0, self.recall, 0.0)
        return np.where(self.positives > 0, perfect.max(axis=-1, initial=0.0), np.nan)

    @property
    def extended_precision(self) -> Floats:
        """The mean of the precision at the highest threshold and of Recall@100%Precision (Ferrarini
        et al., RA-L 2020, DOI 10.1109/LRA.2020.2969197)."""
        return (self._at_highest_threshold + self.recall_at_full_precision) / 2

    @property
    def _added(self) -> Floats:
        """True positives that each threshold adds."""
        return np.diff(self.true_positives, prepend=0.0, axis=-1)

    @cached_property
    def _at_highest_threshold(self) -> Floats:
        """Precision at the highest threshold that accepts anything; 0 if no threshold does."""
        if self.accepted.shape[-1] == 0:
            return np.zeros(self.accepted.shape[:-1])
        first = (self.accepted > 0).argmax(axis=-1)[..., None]
        fraction = self.true_positives / np.maximum(self.accepted, 1)
        return np.take_along_axis(fraction, first, -1)[..., 0]

    @property
    def _at_recall_zero(self) -> Floats:
        first = self._at_highest_threshold
        return first if self.start is None else np.full_like(first, self.start)


@dataclass(frozen=True)
class Ranking:
    """The queries ``(C,)`` that have a candidate by decreasing score of the best one, whether it is
    a true match ``(C,)``, and the last index ``(T,)`` of each distinct score ``(T,)``."""

    order: Rows
    correct: Bools
    last_of_tie: Rows
    thresholds: Floats

    def curve(
        self, weights: Floats, positives: Floats, start: float | None = None
    ) -> PrecisionRecall:
        """The curve of the best candidates; ``weights`` ``(..., Q)`` float64 count the queries, and
        ``positives`` ``(...)`` those that could be found."""
        ranked = weights[..., self.order]
        accepted = np.cumsum(ranked, axis=-1)[..., self.last_of_tie]
        right = np.cumsum(ranked * self.correct, axis=-1)[..., self.last_of_tie]
        return PrecisionRecall(accepted, right, positives, self.thresholds, start)


def rank(scores: Floats, correct: Bools) -> Ranking:
    """Ranks queries by the scores ``(Q,)`` float64 of their best candidates, -inf for none, which
    is never accepted; ``correct`` ``(Q,)`` bool, whether it is a true match."""
    candidates = np.flatnonzero(scores > -np.inf)
    order = candidates[np.argsort(-scores[candidates], kind="stable")]
    ranked = scores[order]
    last = np.flatnonzero(np.diff(ranked, append=-np.inf) != 0)
    return Ranking(order, correct[order], last, ranked[last])


def roc_auc(curve: PrecisionRecall, right: Floats, wrong: Floats) -> Floats:
    """ROC-AUC ``(...)``: the probability that a right best candidate has a higher score than a
    wrong one, ties counted half, as scikit-learn's; NaN where all are ``right`` or ``wrong``, the
    numbers of queries. A query without a candidate is wrong with the lowest score."""
    recognised = np.insert(curve.true_positives, 0, 0.0, axis=-1)
    missed = np.insert(curve.accepted - curve.true_positives, 0, 0.0, axis=-1)
    area = (np.diff(missed) * (recognised[..., 1:] + recognised[..., :-1]) / 2).sum(axis=-1)
    return _divide(area + (wrong - missed[..., -1]) * right, right * wrong)


def _divide(count: Floats, whole: Floats) -> Floats:
    """The quotient, NaN where ``whole`` is 0."""
    return np.where(whole > 0, count / np.where(whole > 0, whole, 1.0), np.nan)
