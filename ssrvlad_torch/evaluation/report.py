"""The report of an evaluation: one HTML page that needs no other file and no server."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from ..datasets.image_files import Pixels
from ..files import new_figure, png_address, replacing, requiring
from .curves import Bools, Outcomes, Truth
from .measure import Evaluation, Material
from .metrics import Convention, figure_rows, fraction, precision_recall_curve
from .thresholds import operating_rows

WRONG_MATCHES, RIGHT_MATCHES = 8, 4

_WIDTH = 400


class Match(NamedTuple):
    """Rows of a query, its best candidate, and its true match of the highest cosine, or -1."""

    query: int
    candidate: int
    true_match: int


def write_report(path: Path, page: str) -> None:
    """Writes the page of `render`, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(page.encode("utf-8", "replace"))


def render(
    evaluation: Evaluation, title: str, settings: Mapping[str, str], notes: Sequence[str] = ()
) -> str:
    """The page as HTML text, from ``templates/report.html``; it needs the extra ``eval``. Its size
    is bounded. ``settings`` are names and values, ``notes`` sentences on top; all may hold any
    text."""
    with requiring("eval", "a report needs"):
        import matplotlib  # noqa: F401
        from jinja2 import Environment, PackageLoader
    environment = Environment(
        loader=PackageLoader(__package__), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["fraction"] = fraction
    matches = chosen_matches(evaluation.ranked, evaluation.truth, evaluation.material)
    return environment.get_template("report.html").render(
        title=title,
        settings=settings,
        notes=notes,
        threshold=evaluation.metrics["threshold_is"],
        metrics=evaluation.metrics,
        figures=figure_rows(evaluation.metrics),
        operating=operating_rows(evaluation.metrics["thresholds"]),
        empty=int((evaluation.outcomes.candidate < 0).sum()),
        curves=_drawn(evaluation),
        above=_from_above(evaluation),
        matches=[[_row(evaluation, match) for match in kind] for kind in matches],
    )


def chosen_matches(
    outcomes: Outcomes, truth: Truth, material: Material
) -> tuple[list[Match], list[Match]]:
    """The wrong and the right best candidates with the highest scores in ``outcomes``, at most
    `WRONG_MATCHES` and `RIGHT_MATCHES`; in a tie, the earlier query comes first."""

    def highest(queries: Bools, most: int) -> list[Match]:
        rows = np.flatnonzero(queries)
        ranked = rows[np.argsort(-outcomes.score[rows], kind="stable")][:most].tolist()
        return [Match(row, int(outcomes.candidate[row]), true_match(row)) for row in ranked]

    def true_match(query: int) -> int:
        rows = truth[query]
        return int(rows[material.cosines(np.array([query]), rows)[0].argmax()]) if len(rows) else -1

    return highest(outcomes.wrong, WRONG_MATCHES), highest(outcomes.correct, RIGHT_MATCHES)


def _drawn(evaluation: Evaluation) -> str:
    """Precision over recall as the address of a PNG: the curves by the convention and by ``exact``,
    and that of the operating points."""
    figure = new_figure(6, 4.2)
    axes = figure.add_subplot()
    convention = evaluation.metrics["convention"]
    exact: Convention = "exact"
    curves = {name: (evaluation.outcomes, name) for name in (exact, convention)}
    curves[evaluation.metrics["threshold_is"]] = evaluation.ranked, exact
    for name, (outcomes, kind) in curves.items():
        curve = precision_recall_curve(outcomes, kind)
        if curve.positives and len(curve.thresholds):
            first = curve.precision[0] if curve.start is None else curve.start
            recall, precision = np.insert(curve.recall, 0, 0), np.insert(curve.precision, 0, first)
            axes.plot(recall, precision, label=name, ls="-" if name == convention else "--")
    for name, point in operating_rows(evaluation.metrics["thresholds"]):
        if point:
            axes.plot(point["recall"], point["precision"], "o", label=name, clip_on=False)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    if axes.has_data():
        figure.legend(loc="outside upper center", ncols=3)
    return png_address(partial(figure.savefig, format="png", dpi=150))


def _from_above(evaluation: Evaluation) -> str:
    """The references and queries of known pose from above, with a line from each query to its best
    candidate, as the address of a PNG; empty without poses."""
    references, queries = (
        frames.poses[:, :2]
        for frames in (evaluation.recognition.references, evaluation.recognition.queries)
    )
    candidates = evaluation.outcomes.candidate
    rows = np.flatnonzero(candidates >= 0)
    ends = np.stack([queries[rows], references[candidates[rows]]], axis=1)
    placed = np.isfinite(ends).all(axis=(1, 2))
    if not placed.any():
        return ""
    from matplotlib.collections import LineCollection

    figure = new_figure(9, 4.5)
    axes = figure.add_subplot()
    axes.plot(*references.T, ".", color="0.7", ms=3, label="references")
    for name, colour, chosen in (
        ("right", "tab:green", evaluation.outcomes.correct[rows] & placed),
        ("wrong", "tab:red", evaluation.outcomes.wrong[rows] & placed),
    ):
        axes.add_collection(LineCollection(list(ends[chosen]), colors=colour, lw=1))
        label = f"{np.count_nonzero(chosen)} queries with a {name} candidate"
        axes.plot(*ends[chosen, 0].T, ".", color=colour, ms=4, label=label)
    axes.set(xlabel="x in metres", ylabel="y in metres")
    axes.set_aspect("equal", adjustable="datalim")
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return png_address(partial(figure.savefig, format="png", dpi=110))


def _row(evaluation: Evaluation, match: Match) -> dict[str, Any]:
    queries, references = evaluation.recognition.queries, evaluation.recognition.references
    outcomes, query = evaluation.outcomes, queries.frames[match.query]
    rank, sure = int(outcomes.rank[match.query]), evaluation.ranked.score[match.query]
    frames = [("query", query, "", evaluation.material.query(query))]
    for role, row, text in (
        ("best candidate", match.candidate, f"{evaluation.metrics['threshold_is']} {sure:.4g}"),
        ("true match", match.true_match, f"rank {rank}" if rank else "not among the candidates"),
    ):
        if row < 0 or (role == "true match" and outcomes.correct[match.query]):
            continue
        frame = references.frames[row]
        metres = math.dist(queries.poses[match.query, :2], references.poses[row, :2])
        away = "" if math.isnan(metres) else f", {metres:.1f}\N{NO-BREAK SPACE}m away"
        frames.append((role, frame, text + away, evaluation.material.reference(frame)))
    addresses = [
        (role, frame, text, [(_picture(pixels), kind) for kind, pixels in pictures.items()])
        for role, frame, text, pictures in frames
    ]
    return {"frames": addresses, "unknown": match.true_match < 0}


def _picture(pixels: Pixels) -> str:
    """The address of a picture, reduced to `_WIDTH` by means, so that thin poles remain."""
    image = Image.fromarray(pixels)
    if image.width > _WIDTH:
        height = max(1, round(image.height * _WIDTH / image.width))
        image = image.resize((_WIDTH, height), Image.Resampling.BOX)
    return png_address(partial(image.save, format="png", optimize=True))
