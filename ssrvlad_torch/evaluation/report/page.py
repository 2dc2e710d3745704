"""The page itself: one HTML file with all that it shows inside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from ...files import replacing
from ..curves import PrecisionRecall
from ..metrics import precision_recall_curve
from .cards import match_card
from .contents import Report
from .matches import Match, choose
from .matrix import matrix_figure
from .plots import precision_recall_plot, recall_plot, score_plot
from .recall import recall_rates
from .tables import definitions, figures, metrics_table, operating_rows, share, thresholds_table

MATCHES_OF_A_KIND = 4
MOST_STEPS = 400

_FIRST_FIGURES = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")

CONVENTIONS = {
    "exact": "A query's best candidate is accepted if its score is at least a threshold, and every "
    "distinct score is one. Recall is a share of the queries that have a true match; a query "
    "without one can only cost precision.",
    "vpr-bench": "As VPR-Bench computes it (Zaffar et al., IJCV 2021): recall is a share of the "
    "right best candidates, so it always ends at 1; RecallRate@N is a share of all queries.",
    "vpr-tutorial": "As the VPR tutorial computes it (Schubert et al., RAM 2024): all pairs, 100 "
    "evenly spaced thresholds; recall is a share of the true pairs.",
    "vpr-tutorial-single": "As the VPR tutorial computes it (Schubert et al., RAM 2024) for single "
    "matches: each query's best pair, 100 evenly spaced thresholds.",
}


def require_place(path: Path) -> None:
    """Refuses a place where no page can be written, before the work is done.

    Raises:
        ValueError: the folder is missing, or a folder stands where the page is to be.
    """
    if not path.parent.is_dir():
        raise ValueError(f"cannot write the report {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ValueError(f"cannot write the report {path}: it is a folder")


def write_report(path: Path, report: Report) -> None:
    """Writes the page, whole or not at all.

    It shows the figures with their intervals, the curves, the thresholds that one may choose, the
    similarity matrix, and at most `MATCHES_OF_A_KIND` matches of each kind. Its size is bounded
    whatever the number of queries and references, and it needs no other file and no network.

    Raises:
        ValueError: no page can be there, see `require_place`.
        OSError: the disk refused; what was at ``path`` is as it was.
    """
    require_place(path)
    page = render(report).encode("utf-8", "replace")
    with replacing(path) as temporary:
        temporary.write_bytes(page)


def render(report: Report) -> str:
    """The page as text."""
    metrics, outcomes = report.metrics, report.outcomes
    convention, points = metrics["convention"], metrics["thresholds"]
    exact = precision_recall_curve(outcomes, report.truth)
    rates = recall_rates(outcomes, report.candidates, of_all=convention == "vpr-bench")
    kinds = choose(report.scores, outcomes, report.truth, MATCHES_OF_A_KIND)
    return Template(_part("page.html")).substitute(
        title=escape(report.title),
        style=_part("style.css"),
        script=_part("script.js"),
        summary=_summary(report),
        notes=_notes(report.notes),
        headlines=_headlines(report),
        convention=escape(convention),
        meaning=CONVENTIONS[convention],
        metrics=metrics_table(metrics),
        precision_recall=precision_recall_plot(report.curve, exact, convention, points),
        recall=recall_plot(rates),
        scores=score_plot(outcomes, points),
        thresholds=thresholds_table(points),
        steps=_steps(exact, points),
        similarity=matrix_figure(report),
        confident=_cards(report, kinds.confident, "No best candidate is wrong."),
        worst=_cards(report, kinds.worst, "No query missed a true match."),
        best=_cards(report, kinds.best, "No best candidate is right."),
        settings=definitions(report.settings),
    )


def _part(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text("utf-8")


def _summary(report: Report) -> str:
    metrics, empty = report.metrics, int((report.outcomes.candidate < 0).sum())
    without = f"; {empty:,} have no candidate" if empty else ""
    return (
        f"{metrics['queries']:,} queries, {metrics['queries_with_match']:,} of them with a true "
        f"match, against {metrics['references']:,} references{without}."
    )


def _notes(notes: Sequence[str]) -> str:
    lines = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f'<ul class="notes">{lines}</ul>' if notes else ""


def _headlines(report: Report) -> str:
    return "".join(
        f"<div><dt>{escape(name)}</dt>"
        f"<dd>{share(value)}<small>95 %: {share(*ends)}</small></dd></div>"
        for name, value, ends in figures(report.metrics)
        if name in _FIRST_FIGURES
    )


def _steps(exact: PrecisionRecall, points: Mapping[str, Any]) -> str:
    """What the script needs to follow the threshold: some of the thresholds, evenly spread over
    the queries, the lowest first, with all that follows from each."""
    last = len(exact.thresholds) - 1
    told = [point for _, point in operating_rows(points) if point]
    marked = [int((exact.thresholds >= point["score"]).sum()) - 1 for point in told]
    spread = np.linspace(0, last, min(last + 1, MOST_STEPS)).round()
    rows = np.unique(np.concatenate((spread, marked)).astype(int))[::-1]
    columns = {
        "score": exact.thresholds,
        "precision": exact.precision,
        "recall": exact.recall,
        "accepted": exact.accepted,
    }
    steps = {name: values[rows].round(5).tolist() for name, values in columns.items()}
    start = points["suggested"] or points["at_precision"]["0.99"]
    score = start["score"] if start else -np.inf
    steps["start"] = int((exact.thresholds[rows] < score).sum())
    return json.dumps(steps if exact.positives else {"score": []})


def _cards(report: Report, matches: list[Match], otherwise: str) -> str:
    return "".join(match_card(report, match) for match in matches) or f"<p>{otherwise}</p>"
