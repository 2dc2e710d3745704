"""Bootstrap confidence intervals over queries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .outcomes import Floats

LEVEL = 0.95
_CELLS = 1 << 22

Interval = tuple[float, float]
Figures = Callable[[Floats], dict[str, Floats]]
"""From ``(B, Q)`` float64, how often each query counts in each resample, to ``(B,)`` figures."""


def bootstrap(figures: Figures, queries: int, resamples: int, seed: int = 0) -> dict[str, Interval]:
    """Percentile intervals of figures, `LEVEL` wide, over resampled queries, by the figure's name.

    A resample draws as many queries as there are, with replacement (Efron, "Bootstrap methods:
    another look at the jackknife", Annals of Statistics 1979). An interval says how the figure
    varies with the choice of queries, and nothing of other maps. Queries of one drive are not
    independent, so the intervals are rather too narrow.

    Args:
        figures: computes the figures of many resamples at once. Resamples in which a figure is NaN
            are left out; its interval is NaN if all are.
        queries: Q.
        resamples: how many, at least 1.
        seed: of the draw; the same seed gives the same intervals.
    """
    rng = np.random.default_rng(seed)
    block = max(1, _CELLS // max(1, queries))
    blocks = [
        figures(_resample(rng, min(block, resamples - start), queries))
        for start in range(0, resamples, block)
    ]
    return {name: _interval(np.concatenate([b[name] for b in blocks])) for name in blocks[0]}


def _resample(rng: np.random.Generator, resamples: int, queries: int) -> Floats:
    """``(resamples, Q)``: how often each query was drawn."""
    if queries == 0:
        return np.zeros((resamples, 0))
    drawn = rng.integers(0, queries, (resamples, queries))
    drawn += queries * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * queries)
    return counts.reshape(resamples, queries).astype(np.float64)


def _interval(values: Floats) -> Interval:
    meant = values[~np.isnan(values)]
    if len(meant) == 0:
        return float("nan"), float("nan")
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(meant, (tail, 100 - tail))
    return float(low), float(high)
