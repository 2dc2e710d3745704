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


def bootstrap(
    figures: Figures, queries: int, resamples: int, seed: int = 0, block: int = 1
) -> dict[str, Interval]:
    """Percentile intervals of figures, at the confidence `LEVEL`, by name, from a number of
    resamples from 1 on; equal seeds give equal ones.

    A resample draws Q queries in blocks of ``block`` neighbours, with replacement; the last query
    is a neighbour of the first, and the last block is cut short (Kuensch, Annals of Statistics
    1989; Politis and Romano 1992). Blocks of 1 are single queries. Resamples in which a figure is
    NaN are left out; the interval is NaN if all are. It shows how a figure varies with the choice
    of queries, not with the map, and is too narrow where more than ``block`` neighbours are alike.
    """
    rng = np.random.default_rng(seed)
    at_once = max(1, _CELLS // max(1, queries))
    batches = []
    for start in range(0, resamples, at_once):
        rows = min(at_once, resamples - start)
        begins = rng.integers(0, queries, (rows, -(-queries // block), 1))
        drawn = (begins + np.arange(block)).reshape(rows, -1)[:, :queries] % max(1, queries)
        drawn += queries * np.arange(rows)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=rows * queries)
        batches.append(figures(counts.reshape(rows, queries).astype(np.float64)))
    tail = 50 * (1 - LEVEL)
    intervals = dict[str, Interval]()
    for name in batches[0]:
        values = np.concatenate([batch[name] for batch in batches])
        defined = values[~np.isnan(values)]
        ends = np.percentile(defined, (tail, 100 - tail)) if len(defined) else (np.nan, np.nan)
        intervals[name] = float(ends[0]), float(ends[1])
    return intervals
