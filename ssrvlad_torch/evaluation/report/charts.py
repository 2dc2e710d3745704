"""The charts of the page: SVG by matplotlib, embedded in the HTML.

The colours of `COLOURS` are replaced by variables of the style sheet, so that a chart follows the
page's theme. ``data-ends`` holds the limits of the axes, ``data-frame`` their position in pixels;
the script uses both to mark the chosen threshold.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from ..curves import PrecisionRecall
from ..outcomes import Bools, Floats, Outcomes
from .contents import Frames
from .recall import ROUND_N, RecallRates

if TYPE_CHECKING:
    from markupsafe import Markup
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "text": "#1d1f23",
    "soft": "#5d6470",
    "rule": "#dcdfe4",
    "chosen": "#1a5fb4",
    "other": "#8d949e",
    "right": "#1a73c7",
    "wrong": "#d4501e",
    "unknown": "#8a3a6a",
    "suggested": "#0b7d52",
}
WIDTH, HEIGHT = 440, 300
FRAME = (60, 426, 12, 252)
"""Position of the axes in pixels: left, right, top, bottom."""

MOST_VECTORS = 2000
"""Largest number of frames that a map draws as vectors; a map of more frames is a bitmap."""

_BINS = 40
_NAMES = {"right": "right", "wrong": "wrong", "unknown": "wrong, place not in the database"}


def precision_recall_chart(
    curve: PrecisionRecall, exact: PrecisionRecall, convention: str, points: Mapping[str, Any]
) -> Markup:
    """Precision against recall by a convention, the curve by ``exact`` if the convention is another
    one, and the operating points, which belong to ``exact``."""
    figure, axes = _axes("recall", "precision")
    axes.set(xlim=(0, 1), ylim=(0, 1))
    if convention != "exact":
        axes.plot(*_from_recall_zero(exact), color=COLOURS["other"], ls="--", label="exact")
    axes.plot(*_from_recall_zero(curve), color=COLOURS["chosen"], label=convention)
    for name, point in points.items():
        if point:
            colour = COLOURS["suggested" if name == "suggested" else "text"]
            axes.plot(point["recall"], point["precision"], "o", color=colour, clip_on=False)
    values = [f"{p:.3f} at recall {r:g}" for r, p in precisions(curve) if not np.isnan(p)]
    text = f"Precision {', '.join(values) or 'is not defined'}."
    return _svg(figure, axes, "pr", f"Precision against recall, convention {convention}", text)


def recall_chart(rates: RecallRates) -> Markup:
    """RecallRate@N over N, with its 95 % intervals."""
    figure, axes = _axes("N, number of candidates", "RecallRate@N")
    most = max(int(rates.n[-1]), 2)
    ticks = [n for n in ROUND_N if n <= most]
    axes.set(xscale="log", xlim=(1, most), ylim=(0, 1))
    axes.set_xticks(ticks, [str(n) for n in ticks])
    axes.minorticks_off()
    axes.fill_between(rates.n, rates.low, rates.high, color=COLOURS["chosen"], alpha=0.18, lw=0)
    axes.plot(rates.n, rates.rate, color=COLOURS["chosen"])
    values = ", ".join(f"{rates.rate[n - 1]:.3f} at {n}" for n in ticks if n <= len(rates.n))
    return _svg(figure, axes, "recall", "RecallRate@N", f"RecallRate {values}.".replace("nan", "-"))


def score_chart(outcomes: Outcomes, suggested: Mapping[str, Any] | None) -> Markup:
    """Histograms of the scores of the best candidates: right ones upwards, wrong ones downwards."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = _axes("score of the best candidate", "queries")
    groups = score_groups(outcomes)
    scores = np.concatenate([*groups.values()])
    low, high = (scores.min(), scores.max()) if len(scores) else (0.0, 1.0)
    margin = 1e-3 if high - low < 1e-9 else 0.0
    edges = np.linspace(low - margin, high + margin, _BINS + 1)
    counts = {name: np.histogram(scores, edges)[0] for name, scores in groups.items()}
    for name, sign, base in (
        ("right", 1, np.zeros(_BINS)),
        ("wrong", -1, np.zeros(_BINS)),
        ("unknown", -1, -counts["wrong"]),
    ):
        axes.bar(
            edges[:-1], sign * counts[name], np.diff(edges), base, align="edge", color=COLOURS[name]
        )
    below = counts["wrong"] + counts["unknown"]
    axes.set(
        xlim=(edges[0], edges[-1]), ylim=(-1.05 * below.max(), 1.05 * max(1, counts["right"].max()))
    )
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter(lambda count, _: f"{abs(count):g}")
    if suggested:
        score = min(max(suggested["score"], edges[0]), edges[-1])
        axes.axvline(score, color=COLOURS["suggested"], ls="--")
    text = "; ".join(f"{_NAMES[name]}: {len(scores)}" for name, scores in groups.items())
    return _svg(figure, axes, "scores", "Scores of the best candidates", f"{text}.")


def score_groups(outcomes: Outcomes) -> dict[str, Floats]:
    """Scores of the best candidates that are right, wrong, and wrong because no reference shows the
    place."""
    return {name: outcomes.score[queries] for name, queries in _groups(outcomes).items()}


def _groups(outcomes: Outcomes) -> dict[str, Bools]:
    has_candidate = outcomes.candidate >= 0
    return {
        "right": outcomes.correct,
        "wrong": has_candidate & ~outcomes.correct & outcomes.has_match,
        "unknown": has_candidate & ~outcomes.has_match,
    }


def map_chart(poses: Floats, references: Frames, outcomes: Outcomes) -> Markup | None:
    """The drives from above, with a line from each wrong query to its candidate; ``None`` without
    poses.

    Args:
        poses: ``(Q, 3)`` poses of the queries, x and y in metres first, NaN where unknown.
        references: the references with their poses.
        outcomes: the outcomes of the queries.
    """
    queries, places = np.asarray(poses[:, :2]), references.poses[:, :2]
    if not (np.isfinite(queries).all(axis=1).any() and np.isfinite(places).all(axis=1).any()):
        return None
    figure, axes = _axes("x in metres", "y in metres")
    raster = len(queries) + len(places) > MOST_VECTORS
    sequences = [frame.rpartition("/")[0] for frame in references.frames]
    for _, rows in groupby(range(len(places)), sequences.__getitem__):
        axes.plot(*places[[*rows]].T, color=COLOURS["other"], lw=1.5, rasterized=raster)
    wrong = np.flatnonzero((outcomes.candidate >= 0) & ~outcomes.correct)
    gaps = np.full((len(wrong), 2), np.nan)
    lines = np.stack((queries[wrong], places[outcomes.candidate[wrong]], gaps), axis=1)
    axes.plot(*lines.reshape(-1, 2).T, color=COLOURS["wrong"], lw=0.7, alpha=0.6, rasterized=raster)
    groups = _groups(outcomes)
    for name, group in groups.items():
        axes.plot(*queries[group].T, ".", color=COLOURS[name], ms=5, rasterized=raster)
    axes.set_aspect("equal", adjustable="datalim")
    text = "; ".join(f"{_NAMES[name]}: {np.count_nonzero(g)}" for name, g in groups.items())
    return _svg(figure, axes, "map", "Trajectories from above", f"{text}.")


def precisions(curve: PrecisionRecall) -> list[tuple[float, float]]:
    """Each tenth of recall with the precision at the highest threshold that reaches it; NaN if no
    threshold does."""
    recalls = np.arange(1, 11) / 10
    reached = [np.flatnonzero(curve.recall >= recall) for recall in recalls]
    return [
        (float(recall), float(curve.precision[rows[0]]) if len(rows) else float("nan"))
        for recall, rows in zip(recalls, reached, strict=True)
    ]


def _from_recall_zero(curve: PrecisionRecall) -> tuple[Floats, Floats]:
    """Recall and precision with the point at recall 0; empty without positives."""
    if not curve.positives or not len(curve.thresholds):
        return np.zeros(0), np.zeros(0)
    first = curve.precision[0] if curve.start is None else curve.start
    return np.insert(curve.recall, 0, 0.0), np.insert(curve.precision, 0, first)


def _axes(x: str, y: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / 72, HEIGHT / 72))
    left, right, top, bottom = FRAME
    box = (left / WIDTH, 1 - bottom / HEIGHT, (right - left) / WIDTH, (bottom - top) / HEIGHT)
    axes = figure.add_axes(box)
    axes.set_xlabel(x, color=COLOURS["text"], labelpad=8)
    axes.set_ylabel(y, color=COLOURS["text"], labelpad=10)
    axes.tick_params(length=0, labelcolor=COLOURS["soft"])
    axes.grid(color=COLOURS["rule"])
    axes.set_axisbelow(True)
    axes.spines[:].set_visible(False)
    return figure, axes


def _svg(figure: Figure, axes: Axes, name: str, title: str, text: str) -> Markup:
    """The figure as an SVG element whose ids begin with ``name``."""
    from markupsafe import Markup
    from matplotlib import rc_context

    content = io.StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(content, format="svg", transparent=True, metadata=no_metadata, dpi=150)
    drawn = content.getvalue().partition("<svg")[2].partition(">")[2]
    drawn = re.sub(r"<style.*?</style>|<!--.*?-->", "", drawn, flags=re.DOTALL)
    drawn = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{name}-", drawn.replace("xlink:href", "href"))
    for variable, colour in COLOURS.items():
        drawn = drawn.replace(colour, f"var(--{variable})")
    ends = " ".join(repr(float(end)) for end in (*axes.get_xlim(), *axes.get_ylim()))
    start = Markup(
        '<svg id="{name}" class="chart" viewBox="0 0 {width} {height}" role="img" '
        'aria-labelledby="{name}-title {name}-text" data-ends="{ends}" data-frame="{frame}">'
        '<title id="{name}-title">{title}</title><desc id="{name}-text">{text}</desc>'
    ).format(
        name=name,
        width=WIDTH,
        height=HEIGHT,
        ends=ends,
        frame=" ".join(map(str, FRAME)),
        title=title,
        text=text,
    )
    return start + Markup(drawn)
