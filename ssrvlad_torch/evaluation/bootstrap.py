"""Bootstrap confidence intervals over queries."""

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

    A resample draws Q queries with replacement (Efron, Annals of Statistics 1979). Those in which a
    figure is NaN are left out; the interval is NaN if all are. It shows how a figure varies with
    the choice of queries, not with the map. Queries of one drive are not independent, so the
    intervals are slightly too narrow.
    """
    rng = np.random.default_rng(seed)
    block = max(1, _CELLS // max(1, queries))
    blocks = []
    for start in range(0, resamples, block):
        rows = min(block, resamples - start)
        drawn = rng.integers(0, queries, (rows, queries)) + queries * np.arange(rows)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=rows * queries)
        blocks.append(figures(counts.reshape(rows, queries).astype(np.float64)))
    tail = 50 * (1 - LEVEL)
    intervals = dict[str, Interval]()
    for name in blocks[0]:
        values = np.concatenate([block[name] for block in blocks])
        defined = values[~np.isnan(values)]
        ends = np.percentile(defined, (tail, 100 - tail)) if len(defined) else (np.nan, np.nan)
        intervals[name] = float(ends[0]), float(ends[1])
    return intervals
