"""RecallRate@N for every N up to a limit, with its intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..bootstrap import bootstrap
from ..metrics import Convention, recall_rates_at
from ..outcomes import Floats, Outcomes, Rows

ROUND_N = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


class RecallRates(NamedTuple):
    """RecallRate@N, all ``(N,)``; NaN where no query counts.

    Attributes:
        n: int64, from 1.
        rate, low, high: float64, the figure and the ends of its 95 % bootstrap interval.
    """

    n: Rows
    rate: Floats
    low: Floats
    high: Floats


def recall_rates(
    outcomes: Outcomes, most: int, convention: Convention = "exact", resamples: int = 1000
) -> RecallRates:
    """RecallRate@1 to RecallRate@``most``, equal to the figures of `evaluate`.

    Args:
        outcomes: outcomes of at least ``most`` candidates per query.
        most: largest N, at least 1.
        convention: as for `evaluate`.
        resamples: number of bootstrap resamples.
    """
    n = np.arange(1, most + 1)

    def figures(weights: Floats) -> dict[str, Floats]:
        return recall_rates_at(outcomes, convention, n.tolist(), weights)

    (rates,) = np.stack([*figures(np.ones((1, len(outcomes)))).values()], axis=1)
    low, high = np.array([*bootstrap(figures, len(outcomes), resamples).values()]).T
    return RecallRates(n, rates, low, high)
