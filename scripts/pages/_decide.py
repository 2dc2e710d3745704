"""What is found for the queries of a condition by a method and steps, and how right it is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from _described import ALONE, BY_SCORES, Condition, Described
from conditions import RESAMPLES

from ssrvlad_torch.evaluation.metrics import evaluate
from ssrvlad_torch.recognition.recognise import Steps, recognise, recognise_by_scores

FIGURES = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")
OFFSET = 10**6


class Decisions(NamedTuple):
    """Candidates of all queries of a condition; rows of the references count through its searches.

    Attributes:
        scores, rows: ``(Q, 5)`` scores and rows of the candidates.
        truth: true matches of each query.
    """

    scores: np.ndarray
    rows: np.ndarray
    truth: list[np.ndarray]

    @property
    def right(self) -> np.ndarray:
        """``(Q,)`` bool, whether the first candidate is a true match."""
        return np.array([row in set(t) for row, t in zip(self.rows[:, 0], self.truth, strict=True)])

    def figures(self) -> dict[str, tuple[float, float, float]]:
        """Each of `FIGURES` with the ends of its 95 % bootstrap interval."""
        measured = evaluate(*self, at=(1, 5), resamples=RESAMPLES)
        ends = measured["intervals"]
        rates = {f"RecallRate@{n}": (measured["recall_at"][n], ends["recall_at"][n]) for n in "15"}
        others = {"AUC-PR": "auc_pr", "Recall@100%Precision": "recall_at_100_precision"}
        rates |= {name: (measured[key], ends[key]) for name, key in others.items()}
        return {name: (value, *low_high) for name, (value, low_high) in rates.items()}


def decide(described: Described, condition: Condition, method: str, steps: Steps) -> Decisions:
    """Finds candidates for the queries of a condition."""
    recognised, truth = [], []
    for number, search in enumerate(condition.searches):
        names = described.sequences(search)
        if steps == ALONE:
            names = [str(number) for number in range(len(names[0]))], names[1]
        if method in BY_SCORES:
            one = recognise_by_scores(described.scores(search, method), *names, steps, 5)
        else:
            queries, town = described.members(search, method, names[1])
            one = recognise(queries, names[0], town, steps, 5)
        recognised.append(one)
        truth += [places + number * OFFSET for places in search.truth]
    return Decisions(
        torch.cat([one.matches.scores for one in recognised]).numpy(),
        torch.cat([one.matches.indices + n * OFFSET for n, one in enumerate(recognised)]).numpy(),
        truth,
    )
