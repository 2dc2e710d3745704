"""The similarity matrix on the page: the cells, and over them the ground truth and what was
taken."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import groupby

from ..outcomes import Rows
from .contents import Frames, Report
from .images import DARKEST, LIGHTEST, mask_address, scores_address, span
from .similarity import similarity_matrix

TRUTH, RIGHT, WRONG = (38, 194, 129), (77, 163, 255), (255, 107, 53)
"""Colours of what is laid over the cells."""

_MOST_NAMED = 24
_WIDEST, _TALLEST = 3.0, 1.0
_CRISP = 400


def matrix_figure(report: Report) -> str:
    """The matrix with its overlays, axes, switches and scale."""
    there = len(report.references.frames)
    matrix = similarity_matrix(report.scores, there, report.outcomes, report.truth)
    if not matrix.scores.size:
        return "<p>There are no pairs.</p>"
    shape = min(max(there / len(report.queries.frames), _TALLEST), _WIDEST)
    crisp = " crisp" if max(matrix.scores.shape) <= _CRISP else ""
    low, high = span(matrix.scores)
    candidates = [(matrix.wrong, WRONG), (matrix.right, RIGHT)]
    return (
        f'<div class="similarity"><div class="axes" style="--shape:{shape:.3f}">'
        f'{_strip("down", report.queries)}<div class="matrix{crisp}">'
        f'<img src="{scores_address(matrix.scores)}" alt="{escape(_description(report))}">'
        f'<img class="truth" src="{mask_address([(matrix.truth, TRUTH)])}" alt="">'
        f'<img class="taken" src="{mask_address(candidates)}" alt=""></div>'
        f'{_strip("across", report.references)}</div><div class="beside">{_switches(low, high)}'
        f"<p>{_caption(matrix.rows, matrix.columns)}</p></div></div>"
    )


def _description(report: Report) -> str:
    return (
        f"Similarity of {len(report.queries.frames):,} queries, from top to bottom, with "
        f"{len(report.references.frames):,} references, from left to right; "
        f"{int(report.outcomes.correct.sum()):,} best candidates are right."
    )


def _caption(rows: Rows, columns: Rows) -> str:
    """What a cell stands for."""
    pairs = [-(-int(edges[-1]) // (len(edges) - 1)) for edges in (rows, columns)]
    if max(pairs) == 1:
        return "Rows are queries, columns references; a cell is the score of a pair."
    return (
        "Rows are queries, columns references. A cell is the highest score of up to "
        f"{pairs[0]} by {pairs[1]} pairs, marked if any of them is a true match or was taken."
    )


def _switches(low: float, high: float) -> str:
    """What can be laid over the matrix, and its scale."""
    return (
        '<div class="switches">'
        f'<label><input type="checkbox" id="show-truth" checked>{_key(TRUTH)}true matches</label>'
        f'<label><input type="checkbox" id="show-taken" checked>{_key(RIGHT)}best candidates that '
        f"are right, {_key(WRONG)}wrong</label>"
        f'<span class="scale">score {low:.3f}<i class="ramp" style="background:linear-gradient('
        f'to right,rgb{DARKEST},rgb{LIGHTEST})"></i>{high:.3f}</span></div>'
    )


def _key(colour: tuple[int, int, int]) -> str:
    return f'<i class="key" style="background:rgb{colour}"></i>'


def _strip(direction: str, frames: Frames) -> str:
    """An axis: the sequences one after another, and the numbers of frames at the ends."""
    runs = [(name, len([*run])) for name, run in groupby(map(_sequence, frames.frames))]
    what = "queries" if direction == "down" else "references"
    names = _named(runs) if len(runs) <= _MOST_NAMED else f"<span>{len(runs)} sequences</span>"
    return (
        f'<div class="strip {direction}"><div class="names">{names}</div>'
        f'<div class="numbers"><span>1</span><span>{what}</span>'
        f"<span>{len(frames.frames):,}</span></div></div>"
    )


def _sequence(frame: str) -> str:
    return frame.rpartition("/")[0]


def _named(runs: Sequence[tuple[str, int]]) -> str:
    return "".join(
        f'<span style="flex:{count}" title="{escape(name)}: {count:,} frames">{escape(name)}</span>'
        for name, count in runs
    )
