"""The matches that the page shows, and the contributions of the parts of their descriptors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..outcomes import Floats, Outcomes, Rows, Truth
from .contents import Scores


class Match(NamedTuple):
    """A query and its best candidate.

    Attributes:
        query, candidate: rows.
        score: score of the candidate.
        correct: whether the candidate is a true match.
        true_match: row of the true match with the highest score if the candidate is wrong and the
            query has one, else -1.
        frame_score, true_frame_score: scores of candidate and true match as single frames, without
            the sequence filter; NaN without a true match.
    """

    query: int
    candidate: int
    score: float
    correct: bool
    true_match: int
    frame_score: float
    true_frame_score: float


class Chosen(NamedTuple):
    """Matches of three kinds, the clearest case of each kind first.

    Attributes:
        confident: wrong matches with the highest scores.
        worst: wrong matches of queries with a true match whose single-frame score is the furthest
            below that of the candidate.
        best: right matches with the highest scores.
    """

    confident: list[Match]
    worst: list[Match]
    best: list[Match]


def choose(scores: Scores, outcomes: Outcomes, truth: Truth, most: int) -> Chosen:
    """At most ``most`` matches of each kind; in a tie, the earlier query comes first."""
    true_match = np.full(len(outcomes), -1, np.int64)
    frame_score, true_frame_score = np.full((2, len(outcomes)), np.nan)
    wrong = ~outcomes.correct & (outcomes.candidate >= 0)
    missed = wrong & outcomes.has_match
    for query in np.flatnonzero(missed).tolist():
        rows = np.append(truth[query], outcomes.candidate[query])
        *true_scores, frame_score[query] = scores(np.array([query]), rows)[0]
        true_match[query] = truth[query][int(np.argmax(true_scores))]
        true_frame_score[query] = max(true_scores)

    def highest(queries: Rows, values: Floats) -> list[Match]:
        ranked = queries[np.argsort(-values[queries], kind="stable")][:most]
        columns = (
            *(outcomes.candidate, outcomes.score, outcomes.correct),
            *(true_match, frame_score, true_frame_score),
        )
        return [Match(row, *(column[row].item() for column in columns)) for row in ranked.tolist()]

    return Chosen(
        confident=highest(np.flatnonzero(wrong), outcomes.score),
        worst=highest(np.flatnonzero(missed), frame_score - true_frame_score),
        best=highest(np.flatnonzero(outcomes.correct), outcomes.score),
    )


def contributions(query: Tensor, references: Tensor, lengths: Sequence[int]) -> Floats:
    """Contributions ``(N, parts)`` float64 of the parts to the cosines of a descriptor ``(D,)`` and
    others ``(N, D)``; the sum of ``lengths``, the lengths of the parts, is D."""
    products = F.normalize(query.double(), dim=0) * F.normalize(references.double(), dim=1)
    sums = [part.sum(1) for part in products.split(list(lengths), dim=1)]
    return np.asarray(torch.stack(sums, 1))
