"""A picture of answers, without ground truth. It needs the extra ``eval`` (matplotlib)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..evaluation.loops import EVEN
from ..evaluation.trajectory import draw_trajectory
from ..files import drawn_text, new_figure
from .answers import Answers
from .material import Material

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXAMPLES = 4
"""Number of queries that are shown beside their answers."""

_ACCEPTED, _DOUBTFUL = "tab:green", "tab:orange"


def draw_answers(answers: Answers, material: Material) -> Figure:
    """Draws the answers to a sequence. Accepted ones are green, doubtful ones orange: those that
    `Answers.accepted` leaves out, or without such a limit those that are more likely wrong.

    If the map has poses, it is drawn from above with a dot at the first candidate of each query,
    and a line to the query's own pose, if it has one. A second chart shows the numbers of queries
    against those of their candidates. Below are queries beside their candidates, from the surest
    to the most doubtful, with their files as far as they are there.
    """
    from matplotlib.collections import LineCollection

    sure = answers.recognised.confidence.numpy()
    rows = answers.recognised.matches.indices[:, 0].numpy()
    least = max(answers.estimate.confidence, EVEN)
    if answers.min_confidence or answers.max_wrong is not None:
        least = answers.estimate.confidence
    answered = np.flatnonzero(rows >= 0)
    poses, places = answers.references.poses, answers.queries.poses
    placed = bool(np.isfinite(poses[:, :2]).all(axis=1).any())
    figure = new_figure(10, 9)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    charts = above.subplots(1, 2 if placed else 1, squeeze=False)[0]
    if placed:
        draw_trajectory(charts[0], poses, answers.references.sequences, "map")
    for name, colour, chosen in (
        ("accepted", _ACCEPTED, answered[sure[answered] >= least]),
        ("doubtful", _DOUBTFUL, answered[sure[answered] < least]),
    ):
        label = f"{name}: {len(chosen)}"
        charts[-1].plot(chosen, rows[chosen], ".", ms=4, color=colour, label=label)
        if placed and len(chosen):
            ends = np.stack((poses[rows[chosen], :2], places[chosen, :2]), axis=1)
            links = [link for link in ends if np.isfinite(link).all()]
            charts[0].add_collection(LineCollection(links, colors=colour, lw=0.8, alpha=0.7))
            charts[0].plot(*ends[:, 0].T, ".", ms=4, color=colour, label=label)
    charts[-1].set(xlabel="number of the query", ylabel="number of its candidate in the map")
    above.legend(*charts[-1].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    order = answered[np.argsort(-sure[answered], kind="stable")]
    examples = order[np.unique(np.linspace(0, len(order) - 1, EXAMPLES).round().astype(int))]
    for column, query in enumerate(examples if len(order) else ()):
        frames = answers.queries.frames[query], answers.references.frames[rows[query]]
        pictures = material.query(frames[0]), material.reference(frames[1])
        for line, (frame, views) in enumerate(zip(frames, pictures, strict=True)):
            axes = below.add_subplot(2, EXAMPLES, line * EXAMPLES + column + 1)
            axes.set_axis_off()
            colour = _ACCEPTED if sure[query] >= least else _DOUBTFUL
            below_name = f"\nconfidence {sure[query]:.2f}" if line == 0 else ""
            axes.set_title(f"{drawn_text(frame)}{below_name}", fontsize=8, color=colour)
            for pixels in [*views.values()][:1]:
                axes.imshow(pixels)
    return figure
