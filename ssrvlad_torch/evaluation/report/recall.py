"""RecallRate@N for every N up to a limit, with its intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..bootstrap import bootstrap
from ..outcomes import Floats, Outcomes, Rows

ROUND_N = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


class RecallRates(NamedTuple):
    """RecallRate@N, all ``(N,)``; NaN where no query counts.

    Attributes:
        n: int64, 1 and up.
        rate, low, high: float64, the figure and its 95 % bootstrap interval.
    """

    n: Rows
    rate: Floats
    low: Floats
    high: Floats


def recall_rates(
    outcomes: Outcomes, most: int, of_all: bool = False, resamples: int = 1000
) -> RecallRates:
    """RecallRate@1 to RecallRate@``most``, with the draws and so the figures of `metrics.evaluate`.

    Args:
        outcomes: judged from at least ``most`` candidates a query.
        most: at least 1.
        of_all: a fraction of all queries, as in VPR-Bench, not of those that have a true match.
        resamples: of the bootstrap.
    """
    asked = np.ones(len(outcomes), bool) if of_all else outcomes.has_match
    found = np.flatnonzero(outcomes.rank)
    order = found[np.argsort(outcomes.rank[found], kind="stable")]
    n = np.arange(1, most + 1)
    ends = np.searchsorted(outcomes.rank[order], n, side="right")

    def rates(weights: Floats) -> Floats:
        total = (weights @ asked)[:, None]
        hits = np.insert(np.cumsum(weights[:, order], axis=1), 0, 0.0, axis=1)[:, ends]
        return np.where(total > 0, hits / np.maximum(total, 1), np.nan)

    def figures(weights: Floats) -> dict[str, Floats]:
        return {str(column): rate for column, rate in enumerate(rates(weights).T)}

    intervals = bootstrap(figures, len(outcomes), resamples)
    low, high = np.array(list(intervals.values())).T
    return RecallRates(n, rates(np.ones((1, len(outcomes))))[0], low, high)
