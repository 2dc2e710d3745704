"""Writes the page: one HTML file that contains its images, styles and script."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ...files import check_output, replacing
from ..curves import PrecisionRecall
from ..metrics import figure_rows, precision_recall_curve
from . import charts, images
from .contents import Frames, Picture, Report
from .matches import Match, choose, contributions
from .recall import ROUND_N, recall_rates
from .similarity import similarity_matrix

MATCHES_OF_A_KIND = 4
MOST_STEPS = 400

NOTHING = "\N{EN DASH}"
TRUTH, RIGHT, WRONG = (38, 194, 129), (77, 163, 255), (255, 107, 53)
"""Colours of the marks on the similarity matrix."""

CONVENTIONS = {
    "exact": "A query's best candidate is accepted if its score is at least the threshold; every "
    "distinct score is a threshold. Recall is a fraction of the queries with a true match; a query "
    "without a true match can only lower the precision.",
    "vpr-bench": "As in VPR-Bench (Zaffar et al., IJCV 2021): recall is a fraction of the right "
    "best candidates, so it always ends at 1; RecallRate@N is a fraction of all queries.",
    "vpr-tutorial": "As in the VPR tutorial (Schubert et al., RAM 2024): all pairs, 100 evenly "
    "spaced thresholds; recall is a fraction of the true pairs.",
    "vpr-tutorial-single": "As in the VPR tutorial (Schubert et al., RAM 2024) for single matches: "
    "each query's best pair, 100 evenly spaced thresholds.",
}
_FIRST_FIGURES = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")
_MOST_NAMED = 24
_WIDEST, _TALLEST = 3.0, 1.0
_CRISP = 400


def write_report(path: Path, report: Report) -> None:
    """Writes the page, whole or not at all.

    The page shows the figures with their intervals, the curves, operating points, the similarity
    matrix, and at most `MATCHES_OF_A_KIND` matches of each kind. Its size is bounded for any number
    of queries and references. It needs no other file and no network.

    Raises:
        ImportError: the extra ``eval`` (Jinja2, matplotlib) is not installed.
        OSError: the file cannot be written; an existing file at ``path`` is unchanged.
    """
    check_output(path)
    page = render(report).encode("utf-8", "replace")
    with replacing(path) as temporary:
        temporary.write_bytes(page)


def render(report: Report) -> str:
    """The page as HTML text, from ``templates/page.html``."""
    try:
        from jinja2 import Environment, PackageLoader
    except ImportError as error:
        raise ImportError("a report needs: pip install ssrvlad-torch[eval]") from error
    metrics, outcomes = report.metrics, report.outcomes
    convention, points = metrics["convention"], metrics["thresholds"]
    exact = precision_recall_curve(outcomes, report.truth)
    rates = recall_rates(outcomes, report.candidates, convention)
    operating, rows = dict(operating_rows(points)), figure_rows(metrics)
    environment = Environment(
        loader=PackageLoader(__package__), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {"fraction": fraction, "isnan": math.isnan, "NOTHING": NOTHING}
    return environment.get_template("page.html").render(
        report=report,
        metrics=metrics,
        empty=int((outcomes.candidate < 0).sum()),
        headlines=[row for row in rows if row[0] in _FIRST_FIGURES],
        figures=rows,
        meaning=CONVENTIONS[convention],
        operating=operating,
        precisions=charts.precisions(report.curve),
        rates=[
            (n, rates.rate[n - 1], rates.low[n - 1], rates.high[n - 1])
            for n in ROUND_N
            if n <= len(rates.n)
        ],
        groups=charts.score_groups(outcomes),
        precision_recall=charts.precision_recall_chart(report.curve, exact, convention, operating),
        recall=charts.recall_chart(rates),
        scores=charts.score_chart(outcomes, points["suggested"]),
        map=charts.map_chart(report.queries.poses, report.references, outcomes),
        steps=_steps(exact, points, operating),
        matrix=_matrix(report),
        matches=[
            [_card(report, match) for match in kind]
            for kind in choose(report.scores, outcomes, report.truth, MATCHES_OF_A_KIND)
        ],
    )


def fraction(*values: float) -> str:
    """A fraction with three digits, or both ends of an interval; a dash for NaN."""
    return NOTHING if any(map(math.isnan, values)) else " to ".join(f"{v:.3f}" for v in values)


def operating_rows(points: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any] | None]]:
    """Names and points of the result of `operating_points`."""
    rows = [
        (f"{kind} {100 * float(value):g}\N{NO-BREAK SPACE}%", point)
        for kind in ("precision", "recall")
        for value, point in points[f"at_{kind}"].items()
    ]
    return [*rows, ("suggested", points["suggested"])]


def _steps(exact: PrecisionRecall, points: Mapping[str, Any], operating: Mapping[str, Any]) -> str:
    """The data of the threshold slider as JSON: thresholds spread evenly over the queries, the
    lowest first, with the figures at each threshold."""
    last = len(exact.thresholds) - 1
    marked = [int((exact.thresholds >= p["score"]).sum()) - 1 for p in operating.values() if p]
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


def _matrix(report: Report) -> dict[str, Any] | None:
    """The similarity matrix as images, with the labels of its axes; ``None`` if it is empty."""
    references = len(report.references.frames)
    matrix = similarity_matrix(report.scores, references, report.outcomes, report.truth)
    if not matrix.scores.size:
        return None
    return {
        "shape": min(max(references / len(report.queries.frames), _TALLEST), _WIDEST),
        "crisp": max(matrix.scores.shape) <= _CRISP,
        "scores": images.scores_uri(matrix.scores),
        "truth": images.mask_uri([(matrix.truth, TRUTH)]),
        "candidates": images.mask_uri([(matrix.wrong, WRONG), (matrix.right, RIGHT)]),
        "colours": {"truth": TRUTH, "right": RIGHT, "wrong": WRONG},
        "ramp": (images.DARKEST, images.LIGHTEST),
        "range": images.score_range(matrix.scores),
        "pairs": [-(-int(ends[-1]) // (len(ends) - 1)) for ends in (matrix.rows, matrix.columns)],
        "queries": _runs(report.queries),
        "references": _runs(report.references),
    }


def _runs(frames: Frames) -> list[tuple[str, int]]:
    """The sequences in order with their lengths; only their number if there are many."""
    sequences = (frame.rpartition("/")[0] for frame in frames.frames)
    runs = [(name, len([*run])) for name, run in groupby(sequences)]
    many = [(f"{len(runs)} sequences", len(frames.frames))]
    return runs if len(runs) <= _MOST_NAMED else many


def _card(report: Report, match: Match) -> dict[str, Any]:
    """The data of a match: the query, its candidate, and the true match if it is another frame."""
    outcomes, query = report.outcomes, report.queries.frames[match.query]
    text = f"score {match.score:.4f}"
    frames = [_frame("query", query, report.query_pictures(query), "")]
    frames.append(_reference(report, match, "best candidate", match.candidate, text))
    if match.true_match >= 0:
        rank = int(outcomes.rank[match.query])
        text = f"rank {rank}" if rank else f"not among the first {report.candidates}"
        if math.isfinite(match.true_frame_score):
            text += f", single-frame score {match.true_frame_score:.4f}"
            text += f" (best candidate {match.frame_score:.4f})"
        else:
            text += ", no score"
        frames.append(_reference(report, match, "true match", match.true_match, text))
    return {
        "correct": match.correct,
        "query": query,
        "frames": frames,
        "columns": _columns(report, match),
        "has_match": bool(outcomes.has_match[match.query]),
    }


def _reference(report: Report, match: Match, role: str, row: int, text: str) -> dict[str, Any]:
    frame = report.references.frames[row]
    metres = math.dist(report.queries.poses[match.query, :2], report.references.poses[row, :2])
    if not math.isnan(metres):
        text += f", {metres:.1f}\N{NO-BREAK SPACE}m away"
    return _frame(role, frame, report.reference_pictures(frame), text)


def _frame(role: str, frame: str, picture: Picture, text: str) -> dict[str, Any]:
    uris = []
    if picture.photo is not None:
        uris.append((images.photo_uri(picture.photo), f"photo of {frame}"))
    if picture.labels is not None:
        uris.append((images.label_uri(picture.labels), f"label map of {frame}"))
    return {"role": role, "frame": frame, "images": uris, "text": text}


def _columns(report: Report, match: Match) -> list[dict[str, Any]]:
    """The contributions of the parts to the cosine of the candidate, and their differences from
    those of the true match."""
    if report.descriptors is None:
        return []
    queries, references, parts = report.descriptors
    rows = [match.candidate, *([match.true_match] if match.true_match >= 0 else [])]
    candidate, *true = contributions(queries[match.query], references[rows], [*parts.values()])
    columns = [("contribution", "part", candidate)]
    if true:
        columns.append(("difference from the true match", "lead", candidate - true[0]))
    return [
        {
            "name": name,
            "kind": kind,
            "texts": [f"{round(float(v), 3) + 0.0:.3f}" for v in (*values, values.sum())],  # no -0
            "negative": (values < 0).tolist(),
            "percent": (100 * np.abs(values) / max(np.abs(values).max(), 1e-9)).round().tolist(),
        }
        for name, kind, values in columns
    ]
