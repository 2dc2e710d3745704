"""Metrics of place recognition by two conventions. Both accept the best candidates of queries whose
scores reach a threshold, which takes every distinct score; they differ in what they count:

| | ``exact`` | ``vpr-bench`` |
|---|---|---|
| positives | queries with a true match | right best candidates |
| precision at recall 0 | that of the highest threshold | 1 |
| RecallRate@N is a fraction of | queries with a true match | all queries |

In ``exact``, a query without a true match is a false positive if it is accepted. ``vpr-bench``
gives the figures that VPR-Bench prints (Zaffar et al., IJCV 2021); its recall always ends at 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from .curves import Floats, Indices, Outcomes, PrecisionRecall, Scores, Truth, judge, rank, roc_auc
from .thresholds import bootstrap, wilson

Convention = Literal["exact", "vpr-bench"]

FIGURES = {
    "auc_pr": "AUC-PR",
    "average_precision": "average precision",
    "recall_at_100_precision": "Recall@100%Precision",
    "extended_precision": "extended precision",
    "roc_auc": "ROC-AUC",
}
"""Keys and names of the figures besides RecallRate@N."""

BLOCK = 10
"""Neighbouring queries that the bootstrap draws together; a tenth of fewer than 100."""


def precision_recall_curve(outcomes: Outcomes, convention: Convention = "exact") -> PrecisionRecall:
    """Precision and recall of the outcomes of queries by a convention."""
    return _curves(outcomes, convention)(np.ones(len(outcomes)))


def evaluate(
    scores: Scores,
    indices: Indices,
    truth: Truth,
    at: Iterable[int] = (1, 5, 10),
    convention: Convention = "exact",
    resamples: int = 0,
    seed: int = 0,
) -> dict[str, Any]:
    """All figures of the candidates of a set of queries.

    Args:
        scores, indices: ``(Q, top)`` from `ssrvlad_torch.match`, tensors or arrays; see `judge`.
        truth: rows of the true matches of each query.
        at: the N of RecallRate@N, at most ``top``.
        resamples, seed: of the `bootstrap`, in blocks of `BLOCK` neighbours; 0 for no intervals.

    Returns:
        ``convention``, ``recall_at`` by N as text, the keys of `FIGURES`, NaN without positives,
        ``queries``, ``queries_with_match``, and with resamples ``intervals``: ``[low, high]``.

    Where all resamples agree, RecallRate@N, and Recall@100%Precision of 1, have Wilson's interval
    of queries / block independent ones; of other figures both ends are equal, though they are not
    certain. An unknown convention is a ValueError."""
    outcomes, at = judge(scores, indices, truth), list(at)
    curves = _curves(outcomes, convention)
    figures = partial(_figures, outcomes, convention, curves, at)
    values = {name: float(value[0]) for name, value in figures(np.ones((1, len(truth)))).items()}
    result = {
        "convention": convention,
        **_nested(values, at),
        "queries": len(outcomes),
        "queries_with_match": int(outcomes.has_match.sum()),
    }
    if resamples:
        block = max(1, min(BLOCK, len(outcomes) // 10))
        intervals = bootstrap(figures, len(outcomes), resamples, seed, block)
        bench = convention == "vpr-bench"
        wholes = dict.fromkeys(map(str, at), len(outcomes) if bench else outcomes.has_match.sum())
        if values["recall_at_100_precision"] == 1:
            of = outcomes.correct if bench else outcomes.has_match
            wholes["recall_at_100_precision"] = of.sum()
        for name, whole in wholes.items():
            low, high = intervals[name]
            if low == high:
                intervals[name] = wilson(values[name], int(whole) / block)
        result["intervals"] = _nested({name: list(i) for name, i in intervals.items()}, at)
    return result


def fraction(*values: float) -> str:
    """A fraction with three digits, or both ends of an interval; ``-`` for NaN."""
    return "-" if any(map(math.isnan, values)) else " to ".join(f"{v:.3f}" for v in values)


def figure_rows(metrics: Mapping[str, Any]) -> list[tuple[str, float, Sequence[float]]]:
    """Name, value and interval of every figure of `evaluate` with intervals."""
    rates, intervals = metrics["recall_at"], metrics["intervals"]
    return [
        *((f"RecallRate@{n}", rate, intervals["recall_at"][n]) for n, rate in rates.items()),
        *((name, metrics[key], intervals[key]) for key, name in FIGURES.items()),
    ]


def _figures(
    outcomes: Outcomes,
    convention: Convention,
    curves: Callable[[Floats], PrecisionRecall],
    at: Sequence[int],
    weights: Floats,
) -> dict[str, Floats]:
    """RecallRates by N as text, and the keys of `FIGURES`; ``weights`` as for `_curves`."""
    counted = np.ones(len(outcomes), bool) if convention == "vpr-bench" else outcomes.has_match
    total = weights @ counted
    rates = {}
    for n in at:
        recognised = weights @ ((outcomes.rank > 0) & (outcomes.rank <= n))
        rates[str(n)] = np.where(total > 0, recognised / np.maximum(total, 1), np.nan)
    curve, right = curves(weights), weights @ outcomes.correct
    summaries = {
        "auc_pr": curve.auc,
        "average_precision": curve.average_precision,
        "recall_at_100_precision": curve.recall_at_full_precision,
        "extended_precision": curve.extended_precision,
        "roc_auc": roc_auc(curve, right, weights.sum(axis=1) - right),
    }
    return rates | summaries


def _curves(outcomes: Outcomes, convention: Convention) -> Callable[[Floats], PrecisionRecall]:
    """A function from weights ``(..., Q)`` float64, the count of each query, to the curve."""
    if convention not in ("exact", "vpr-bench"):
        raise ValueError(f"convention must be one of exact, vpr-bench, got {convention!r}")
    ranking = rank(outcomes.score, outcomes.correct)
    if convention == "vpr-bench":
        return lambda weights: ranking.curve(weights, weights @ outcomes.correct, start=1.0)
    return lambda weights: ranking.curve(weights, weights @ outcomes.has_match)


def _nested(figures: dict[str, Any], at: list[int]) -> dict[str, Any]:
    """The figures with the RecallRates, whose names are N, moved to ``recall_at``."""
    rates = {str(n): figures[str(n)] for n in at}
    remaining = {name: figure for name, figure in figures.items() if name not in rates}
    return {"recall_at": rates, **remaining}
