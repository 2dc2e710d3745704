"""The matches that are worth a look, and what each category adds to their scores."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch.nn.functional as F
from torch import Tensor

from ..outcomes import Floats, Outcomes, Rows, Truth
from .scores import Scores


class Match(NamedTuple):
    """A query and what was taken for its place.

    Attributes:
        query, candidate: rows of the query, and of its best candidate.
        score: of the candidate.
        correct: whether the candidate is a true match.
        true_match: row of the true match with the highest score where the candidate is none, else
            -1; also -1 where there is no true match.
        true_score: its score; NaN where there is none.
    """

    query: int
    candidate: int
    score: float
    correct: bool
    true_match: int
    true_score: float


class Chosen(NamedTuple):
    """Some matches of each kind, the strongest case of its kind first.

    Attributes:
        confident: wrong, the highest score first.
        worst: wrong although there is a true match, which scores furthest below the candidate.
        best: right, the highest score first.
    """

    confident: list[Match]
    worst: list[Match]
    best: list[Match]


def choose(scores: Scores, outcomes: Outcomes, truth: Truth, most: int) -> Chosen:
    """At most so many matches of each kind; of equal cases the earlier query comes first."""
    true_match = np.full(len(outcomes), -1, np.int64)
    true_score = np.full(len(outcomes), np.nan)
    wrong = ~outcomes.correct & (outcomes.candidate >= 0)
    missed = wrong & outcomes.has_match
    for query in np.flatnonzero(missed).tolist():
        there = scores(np.array([query]), truth[query])[0]
        true_match[query] = truth[query][there.argmax()]
        true_score[query] = there.max()

    def first(kind: Rows, strength: Floats) -> list[Match]:
        ranked = kind[np.argsort(-strength[kind], kind="stable")][:most]
        columns = (outcomes.candidate, outcomes.score, outcomes.correct, true_match, true_score)
        return [Match(row, *(column[row].item() for column in columns)) for row in ranked.tolist()]

    return Chosen(
        confident=first(np.flatnonzero(wrong), outcomes.score),
        worst=first(np.flatnonzero(missed), outcomes.score - true_score),
        best=first(np.flatnonzero(outcomes.correct), outcomes.score),
    )


class Parts(NamedTuple):
    """What each block of two descriptors of length 1 adds, ``(N, blocks)`` float64 each.

    Attributes:
        score: sums to the cosine.
        difference: sums to the squared Euclidean distance, ``2 - 2 * cosine``.
    """

    score: Floats
    difference: Floats


def parts(query: Tensor, references: Tensor, blocks: int) -> Parts:
    """What each of the equal blocks of the descriptors adds, one a category.

    Args:
        query: ``(D,)`` float.
        references: ``(N, D)`` float.
        blocks: how many; it divides D.
    """
    here, there = F.normalize(query.double(), dim=0), F.normalize(references.double(), dim=1)

    def summed(terms: Tensor) -> Floats:
        sums: Floats = terms.unflatten(1, (blocks, -1)).sum(2).numpy()
        return sums

    return Parts(summed(here * there), summed((here - there) ** 2))
