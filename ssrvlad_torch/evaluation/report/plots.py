"""The plots of the page: precision against recall, RecallRate@N, and the scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..curves import PrecisionRecall
from ..outcomes import Floats, Outcomes
from .charts import Axis, Plane, band, bar, chart, dot, legend, line, linear_axis, upright
from .recall import RecallRates
from .tables import NOTHING, operating_rows, plain_table, share

_BINS = 40
_TENTHS = tuple(tenth / 10 for tenth in range(0, 11, 2))
_ROUND_N = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_TOLD_RECALLS = tuple(tenth / 10 for tenth in range(1, 11))


def precision_recall_plot(
    curve: PrecisionRecall, exact: PrecisionRecall, convention: str, points: Mapping[str, Any]
) -> str:
    """Precision against recall by the chosen convention, the one by ``exact`` beside it if it is
    another, on which the operating points lie."""
    plane = Plane(Axis("recall", 0, 1, _TENTHS), Axis("precision", 0, 1, _TENTHS))
    kinds = [("chosen", curve, convention)]
    if convention != "exact":
        kinds.insert(0, ("other", exact, "exact"))
    marks = [line(plane, *_from_recall_zero(c), kind) for kind, c, _ in kinds]
    for name, point in operating_rows(points):
        if point:
            kind = "suggested" if name == "suggested" else "operating"
            label = f"{name}: score {point['score']:.4f}, precision {share(point['precision'])}"
            marks.append(dot(plane, point["recall"], point["precision"], kind, label))
    told = [(f"{recall:g}", share(_precision_at(curve, recall))) for recall in _TOLD_RECALLS]
    title = f"Precision against recall, convention {convention}"
    known = [
        f"{precision} at recall {recall}" for recall, precision in told if precision != NOTHING
    ]
    entries = [(kind, name) for kind, _, name in reversed(kinds)]
    entries += [("operating", "thresholds of the table"), ("suggested", "suggested")]
    return (
        chart("pr", plane, marks, title, f"Precision {', '.join(known) or 'has no meaning'}.")
        + legend(entries)
        + plain_table("The numbers", ("recall", "precision"), told)
    )


def recall_plot(rates: RecallRates) -> str:
    """RecallRate@N over N, with its 95 % intervals."""
    most = max(int(rates.n[-1]), 2)
    ticks = tuple(n for n in _ROUND_N if n <= most)
    plane = Plane(
        Axis("N, candidates looked at", 1, most, ticks, logarithmic=True),
        Axis("RecallRate@N", 0, 1, _TENTHS),
    )
    n, meant = rates.n.astype(np.float64), ~np.isnan(rates.rate)
    marks = [
        band(plane, n, rates.low, rates.high, "chosen"),
        line(plane, n[meant], rates.rate[meant], "chosen"),
    ]
    told = [
        (str(tick), share(rates.rate[tick - 1]), share(rates.low[tick - 1], rates.high[tick - 1]))
        for tick in ticks
        if tick <= len(n)
    ]
    text = ", ".join(f"{rate} at {tick}" for tick, rate, _ in told)
    return (
        chart("recall", plane, marks, "RecallRate@N", f"RecallRate {text}.")
        + legend([("chosen", "RecallRate@N"), ("area", "95 % interval")])
        + plain_table("The numbers", ("N", "RecallRate@N", "95 % interval"), told)
    )


def score_plot(outcomes: Outcomes, points: Mapping[str, Any]) -> str:
    """How many best candidates have which score: the right ones upwards, the wrong ones
    downwards."""
    taken = outcomes.candidate >= 0
    groups = {
        "right": outcomes.score[outcomes.correct],
        "wrong": outcomes.score[taken & ~outcomes.correct & outcomes.has_match],
        "unknown": outcomes.score[taken & ~outcomes.has_match],
    }
    everything = outcomes.score[taken]
    low, high = (everything.min(), everything.max()) if len(everything) else (0.0, 1.0)
    axis = linear_axis("score of the best candidate", float(low), float(high))
    edges = np.linspace(axis.low, axis.high, _BINS + 1)
    counts = {name: np.histogram(scores, edges)[0] for name, scores in groups.items()}
    below = counts["wrong"] + counts["unknown"]
    reach = float(below.max()), float(max(counts["right"].max(), 1))
    plane = Plane(axis, linear_axis("queries", -reach[0], reach[1], whole=True))
    marks = [mark for place in range(_BINS) for mark in _bars(plane, edges, counts, place)]
    if points["suggested"]:
        score = points["suggested"]["score"]
        label = f"suggested threshold {score:.4f}"
        marks.append(upright(plane, min(max(score, axis.low), axis.high), "suggested", label))
    names = {"right": "right", "wrong": "wrong", "unknown": "wrong, the place is not there"}
    entries = [(kind, f"{names[kind]} ({len(groups[kind])})") for kind in names]
    told = [(names[kind], str(len(scores)), _middle(scores)) for kind, scores in groups.items()]
    text = "; ".join(f"{name}: {count}, median score {middle}" for name, count, middle in told)
    return (
        chart("scores", plane, marks, "Scores of the best candidates", f"{text}.")
        + legend(entries)
        + plain_table("The numbers", ("best candidate", "queries", "median score"), told)
    )


def _bars(plane: Plane, edges: Floats, counts: Mapping[str, Any], place: int) -> list[str]:
    sides = (edges[place], edges[place + 1])
    right, wrong, unknown = (int(counts[name][place]) for name in ("right", "wrong", "unknown"))
    ends = {"right": (0, right), "wrong": (0, -wrong), "unknown": (-wrong, -wrong - unknown)}
    return [bar(plane, sides, span, kind) for kind, span in ends.items() if span[0] != span[1]]


def _from_recall_zero(curve: PrecisionRecall) -> tuple[Floats, Floats]:
    """Recall and precision with the point at recall 0; nothing where there are no positives."""
    if not curve.positives or not len(curve.thresholds):
        return np.zeros(0), np.zeros(0)
    first = curve.precision[0] if curve.start is None else curve.start
    return np.insert(curve.recall, 0, 0.0), np.insert(curve.precision, 0, first)


def _precision_at(curve: PrecisionRecall, recall: float) -> float:
    """At the highest threshold that reaches a recall; NaN if none does."""
    reached = np.flatnonzero(curve.recall >= recall)
    return float(curve.precision[reached[0]]) if len(reached) else float("nan")


def _middle(scores: Floats) -> str:
    return f"{np.median(scores):.4f}" if len(scores) else NOTHING
