"""Bootstrap confidence intervals over queries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .outcomes import Floats

LEVEL = 0.95
_CELLS = 1 << 22

Interval = tuple[float, float]
Figures = Callable[[Floats], dict[str, Floats]]
"""A function from weights ``(B, Q)`` float64, the count of each query in each resample, to figures
``(B,)`` by name."""


def bootstrap(figures: Figures, queries: int, resamples: int, seed: int = 0) -> dict[str, Interval]:
    """Percentile intervals of figures, at the confidence `LEVEL`, by name, from a number of
    resamples from 1 on; equal seeds give equal ones.

    A resample draws Q queries with replacement (Efron, "Bootstrap methods: another look at the
    jackknife", Annals of Statistics 1979). Those in which a figure is NaN are left out; the
    interval is NaN if all are. An interval shows how a figure varies with the choice of queries,
    not with the map. Queries of one drive are not independent, so the intervals are slightly too
    narrow.
    """
    rng = np.random.default_rng(seed)
    block = max(1, _CELLS // max(1, queries))
    blocks = [
        figures(_resample(rng, min(block, resamples - start), queries))
        for start in range(0, resamples, block)
    ]
    return {name: _interval(np.concatenate([b[name] for b in blocks])) for name in blocks[0]}


def _resample(rng: np.random.Generator, resamples: int, queries: int) -> Floats:
    """Counts ``(resamples, Q)`` of the draws of each query."""
    if queries == 0:
        return np.zeros((resamples, 0))
    drawn = rng.integers(0, queries, (resamples, queries))
    drawn += queries * np.arange(resamples)[:, None]
    counts = np.bincount(drawn.ravel(), minlength=resamples * queries)
    return counts.reshape(resamples, queries).astype(np.float64)


def _interval(values: Floats) -> Interval:
    defined = values[~np.isnan(values)]
    if len(defined) == 0:
        return float("nan"), float("nan")
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(defined, (tail, 100 - tail))
    return float(low), float(high)
