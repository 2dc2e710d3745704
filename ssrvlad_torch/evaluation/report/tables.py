"""The tables of the page: figures with their intervals, thresholds, settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import Any

FIGURES = {
    "auc_pr": "AUC-PR",
    "average_precision": "average precision",
    "recall_at_100_precision": "Recall@100%Precision",
    "extended_precision": "extended precision",
    "roc_auc": "ROC-AUC",
}

NOTHING = "\N{EN DASH}"


def share(*values: float) -> str:
    """A share in three digits, or the two ends of an interval; a dash for NaN."""
    return NOTHING if any(map(math.isnan, values)) else " to ".join(f"{v:.3f}" for v in values)


def figures(metrics: Mapping[str, Any]) -> Iterator[tuple[str, float, Sequence[float]]]:
    """Name, value and interval of every figure of `metrics.evaluate`."""
    intervals = metrics["intervals"]
    for n, rate in metrics["recall_at"].items():
        yield f"RecallRate@{n}", rate, intervals["recall_at"][n]
    for key, name in FIGURES.items():
        yield name, metrics[key], intervals[key]


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Every figure with its interval, in digits and drawn from 0 to 1."""
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{share(value)}</td>'
        f"<td>{share(*ends)}</td><td>{_whisker(value, ends)}</td></tr>"
        for name, value, ends in figures(metrics)
    )
    head = "".join(
        f'<th scope="col">{name}</th>' for name in ("figure", "value", "95 % interval", "0 to 1")
    )
    return f'<table class="figures"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'


def thresholds_table(points: Mapping[str, Any]) -> str:
    """What happens at each threshold that one may choose."""
    columns = ("threshold for", "score", "precision", "lower end", "recall", "accepted")
    head = "".join(f'<th scope="col">{column}</th>' for column in columns)
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th>{"".join(map(_cell, _point(point)))}</tr>'
        for name, point in operating_rows(points)
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def operating_rows(points: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any] | None]]:
    """The points of `operating_points` by their names."""
    return [
        *((f"precision {percent(p)}", point) for p, point in points["at_precision"].items()),
        *((f"recall {percent(r)}", point) for r, point in points["at_recall"].items()),
        ("suggested", points["suggested"]),
    ]


def percent(value: str) -> str:
    """A share given as text, in per cent."""
    return f"{100 * float(value):g}\N{NO-BREAK SPACE}%"


def definitions(entries: Mapping[str, str]) -> str:
    """Names and what they are, as a list."""
    rows = (f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in entries.items())
    return f'<dl class="settings">{"".join(rows)}</dl>'


def plain_table(summary: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table that is folded away under its summary."""
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in columns)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(map(_cell, row[1:]))}</tr>'
        for row in rows
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f"<details><summary>{escape(summary)}</summary>{table}</details>"


def _cell(text: str) -> str:
    return f"<td>{escape(text)}</td>"


def _point(point: Mapping[str, Any] | None) -> list[str]:
    if point is None:
        return ["none", *[NOTHING] * 4]
    shares = [share(point[key]) for key in ("precision", "precision_low", "recall")]
    return [f"{point['score']:.4f}", *shares, str(point["accepted"])]


def _whisker(value: float, ends: Sequence[float]) -> str:
    if any(map(math.isnan, (value, *ends))):
        return ""
    low, middle, high = (f"{100 * v:.1f}" for v in (ends[0], value, ends[1]))
    return (
        '<svg class="whisker" viewBox="-3 0 106 12" aria-hidden="true">'
        '<line class="grid" x1="0" x2="100" y1="6" y2="6"/>'
        f'<line class="reach" x1="{low}" x2="{high}" y1="6" y2="6"/>'
        f'<circle cx="{middle}" cy="6" r="3"/></svg>'
    )
