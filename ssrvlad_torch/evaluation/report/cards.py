"""Cards of the matches that are worth a look: pictures, scores, and what each category adds."""

from __future__ import annotations

import math
from html import escape

from .categories import categories_table
from .contents import Picture, Report
from .images import label_address, photo_address
from .matches import Match


def match_card(report: Report, match: Match) -> str:
    """An ``<article>``: the query beside what was taken, and the true match if that is another."""
    sign, verdict = ("✓", "right") if match.correct else ("✗", "wrong")
    query = report.queries.frames[match.query]
    frames = [_frame("query", query, report.query_pictures(query), "")]
    frames.append(_reference(report, match, "taken", match.candidate, _score(match.score)))
    if match.true_match >= 0:
        text = f"{_score(match.true_score)}, {_place(report, match)}"
        frames.append(_reference(report, match, "true match", match.true_match, text))
    table = categories_table(report.descriptors, match) if report.descriptors else ""
    return (
        f'<article class="match"><h4><span class="verdict {verdict}">{sign} {verdict}</span> '
        f'{escape(query)}</h4><div class="frames">{"".join(frames)}</div>{table}'
        f"{_absence(report, match)}</article>"
    )


def _reference(report: Report, match: Match, role: str, row: int, text: str) -> str:
    frame = report.references.frames[row]
    steps = report.queries.poses[match.query, :2] - report.references.poses[row, :2]
    metres = math.hypot(*steps)
    away = "" if math.isnan(metres) else f", {metres:.1f}\N{NO-BREAK SPACE}m away"
    return _frame(role, frame, report.reference_pictures(frame), text + away)


def _frame(role: str, frame: str, picture: Picture, text: str) -> str:
    images = []
    if picture.photo is not None:
        images.append((photo_address(picture.photo), f"photo of {frame}"))
    if picture.labels is not None:
        images.append((label_address(picture.labels), f"label map of {frame}"))
    shown = "".join(f'<img src="{address}" alt="{escape(alt)}">' for address, alt in images)
    return (
        f'<figure class="frame">{shown or "<p>no picture</p>"}<figcaption><b>{role}</b> '
        f"<span>{escape(frame)}</span><br>{escape(text)}</figcaption></figure>"
    )


def _score(score: float) -> str:
    return f"score {score:.4f}" if math.isfinite(score) else "matches nothing"


def _place(report: Report, match: Match) -> str:
    """Where the first true match stands among the candidates."""
    rank = int(report.outcomes.rank[match.query])
    return f"ranked {rank}" if rank else f"not among the first {report.candidates}"


def _absence(report: Report, match: Match) -> str:
    if report.outcomes.has_match[match.query]:
        return ""
    return "<p>No reference shows this place: no candidate should have been taken.</p>"
