"""The matches that are worth a look, and what each part of their descriptors adds."""

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
        score: of the candidate.
        correct: whether the candidate is a true match.
        true_match: row of the true match with the highest score if the candidate is wrong; -1 if
            there is none.
        alone, true_alone: scores of candidate and true match as single frames, without what the
            sequence adds; NaN where there is no true match.
    """

    query: int
    candidate: int
    score: float
    correct: bool
    true_match: int
    alone: float
    true_alone: float


class Chosen(NamedTuple):
    """Some matches of each kind, the strongest case of its kind first.

    Attributes:
        confident: wrong, the highest score first.
        worst: wrong although there is a true match; the widest margin between the two alone first.
        best: right, the highest score first.
    """

    confident: list[Match]
    worst: list[Match]
    best: list[Match]


def choose(scores: Scores, outcomes: Outcomes, truth: Truth, most: int) -> Chosen:
    """At most ``most`` matches of each kind; of equal cases the earlier query comes first."""
    true_match = np.full(len(outcomes), -1, np.int64)
    alone, true_alone = np.full((2, len(outcomes)), np.nan)
    wrong = ~outcomes.correct & (outcomes.candidate >= 0)
    missed = wrong & outcomes.has_match
    for query in np.flatnonzero(missed).tolist():
        rows = np.append(truth[query], outcomes.candidate[query])
        *there, alone[query] = scores(np.array([query]), rows)[0]
        true_match[query] = truth[query][int(np.argmax(there))]
        true_alone[query] = max(there)

    def first(kind: Rows, strength: Floats) -> list[Match]:
        ranked = kind[np.argsort(-strength[kind], kind="stable")][:most]
        columns = (
            *(outcomes.candidate, outcomes.score, outcomes.correct),
            *(true_match, alone, true_alone),
        )
        return [Match(row, *(column[row].item() for column in columns)) for row in ranked.tolist()]

    return Chosen(
        confident=first(np.flatnonzero(wrong), outcomes.score),
        worst=first(np.flatnonzero(missed), alone - true_alone),
        best=first(np.flatnonzero(outcomes.correct), outcomes.score),
    )


def parts(query: Tensor, references: Tensor, lengths: Sequence[int]) -> Floats:
    """``(N, parts)`` float64: what each part adds to the cosines of a descriptor ``(D,)`` and
    others ``(N, D)``; ``lengths`` are those of the parts, D in all."""
    here, there = F.normalize(query.double(), dim=0), F.normalize(references.double(), dim=1)
    added = [part.sum(1) for part in (here * there).split(list(lengths), dim=1)]
    found: Floats = torch.stack(added, 1).numpy()
    return found
