"""Statistics: bootstrap intervals, and the confidence or score from which on to accept."""

import math
from collections.abc import Callable, Mapping
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from .curves import Floats, PrecisionRecall

LEVEL = 0.95
_CELLS = 1 << 22

Interval = tuple[float, float]
Figures = Callable[[Floats], dict[str, Floats]]
"""A function from weights ``(B, Q)`` float64, the count of each query in each resample, to figures
``(B,)`` by name."""


def bootstrap(
    figures: Figures, queries: int, resamples: int, seed: int = 0, block: int = 1
) -> dict[str, Interval]:
    """Percentile intervals of figures, at the confidence `LEVEL`, from a number of resamples. Each
    draws Q queries in blocks of neighbours, with replacement, in a ring (Kuensch, Annals of
    Statistics 1989; Politis and Romano 1992); NaN are left out. It shows how a figure varies with
    the choice of queries, not with the map."""
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


SURE_PRECISION = 0.95
_Z2 = NormalDist().inv_cdf((1 + LEVEL) / 2) ** 2


class OperatingPoint(NamedTuple):
    """A threshold, its precision and recall, 0 to 1, the lower end of the 95 % interval of the
    precision, see `wilson_low`, and the number of accepted queries."""

    threshold: float
    precision: float
    precision_low: float
    recall: float
    accepted: int


def at_precision(curve: PrecisionRecall, precision: float) -> OperatingPoint | None:
    """The lowest threshold whose precision is at least ``precision``, 0 to 1, or ``None``. Some
    higher thresholds may have a lower precision."""
    reached = np.flatnonzero(curve.precision >= precision)
    return _point(curve, int(reached[-1])) if len(reached) else None


def at_recall(curve: PrecisionRecall, recall: float) -> OperatingPoint | None:
    """The highest threshold whose recall is at least ``recall``, 0 to 1, or ``None``."""
    reached = np.flatnonzero(curve.recall >= recall)
    return _point(curve, int(reached[0])) if len(reached) else None


def suggested_point(
    curve: PrecisionRecall, precision: float = SURE_PRECISION
) -> OperatingPoint | None:
    """The lowest threshold whose precision has a lower bound of at least ``precision``, or that
    with the highest; ``None`` if no accepted query is right. For alike neighbours, and the best of
    many thresholds, the bound is too high. It has few decimals, below the score, in float32."""
    low = wilson_low(curve.true_positives, curve.accepted)
    if not low.max(initial=0.0):
        return None
    last = int(np.flatnonzero(low >= min(precision, float(low.max())))[-1])
    score = float(curve.thresholds[last])
    lower = float(curve.thresholds[last + 1]) if last + 1 < len(curve.thresholds) else score - 0.01
    middle = (score + lower) / 2
    rounded = (round(middle, decimals) for decimals in range(2, 10))
    between = next((x for x in rounded if np.float32(lower) < np.float32(x) < score), middle)
    return _point(curve, last)._replace(threshold=between)


def queries_needed() -> int:
    """The least number of accepted queries, all right, with a lower bound of `SURE_PRECISION`."""
    return math.ceil(_Z2 * SURE_PRECISION / (1 - SURE_PRECISION))


def operating_points(curve: PrecisionRecall) -> dict[str, Any]:
    """Points as mappings, or ``None``: ``at_precision`` by ``"0.99"`` and ``"1"``, ``at_recall`` by
    ``"0.5"``, and ``suggested``; of a curve by the convention ``exact``."""

    def mapping(point: OperatingPoint | None) -> dict[str, Any] | None:
        return point and point._asdict()

    return {
        "at_precision": {f"{p:g}": mapping(at_precision(curve, p)) for p in (0.99, 1.0)},
        "at_recall": {"0.5": mapping(at_recall(curve, 0.5))},
        "suggested": mapping(suggested_point(curve)),
    }


def operating_rows(points: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any] | None]]:
    """Names and points of the result of `operating_points`."""
    return [
        *((f"precision {value}", point) for value, point in points["at_precision"].items()),
        *((f"recall {value}", point) for value, point in points["at_recall"].items()),
        ("suggested", points["suggested"]),
    ]


def wilson_low(right: Floats, accepted: Floats) -> Floats:
    """Lower end of Wilson's interval of ``right / accepted`` at the confidence `LEVEL` (Wilson,
    JASA 1927); 0 where ``accepted`` is 0."""
    n = np.maximum(accepted, 1)
    middle, spread = _wilson(right / n, n)
    return np.maximum(middle - spread, 0.0)


def wilson(fraction: float, count: float) -> Interval:
    """Both ends of Wilson's interval of a fraction of ``count``, above 0, at the confidence
    `LEVEL`."""
    middle, spread = (float(x) for x in _wilson(np.array(fraction), np.array(count)))
    return max(middle - spread, 0.0), min(middle + spread, 1.0)


def _wilson(fraction: Floats, n: Floats) -> tuple[Floats, Floats]:
    """The middle of Wilson's intervals, and half their widths."""
    spread = np.sqrt(_Z2 * fraction * (1 - fraction) / n + (_Z2 / n / 2) ** 2)
    return (fraction + _Z2 / n / 2) / (1 + _Z2 / n), spread / (1 + _Z2 / n)


def _point(curve: PrecisionRecall, index: int) -> OperatingPoint:
    return OperatingPoint(
        threshold=float(curve.thresholds[index]),
        precision=float(curve.precision[index]),
        precision_low=float(wilson_low(curve.true_positives, curve.accepted)[index]),
        recall=float(curve.recall[index]),
        accepted=int(curve.accepted[index]),
    )
