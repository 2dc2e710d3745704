"""A picture of the loops of a stream. It needs the extra ``eval`` (matplotlib)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..evaluation.curves import Floats, Rows
from ..evaluation.trajectory import DARK, GRAY, draw_trajectory
from ..files import drawn_text, new_figure
from ..recognition.recognise import runs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RIGHT, _WRONG, _UNJUDGED = "tab:green", "tab:red", "tab:blue"


def draw_loops(
    loops: Rows,
    poses: Floats,
    title: str,
    metres: float | None = None,
    sequences: Sequence[str] | None = None,
    candidates: Rows | None = None,
) -> Figure:
    """Draws a stream of N frames. ``loops`` ``(N,)`` int64 has for each frame the row with which it
    closes a loop, -1 for none; ``candidates``, of the same form, the row of its candidate, drawn
    faintly where no loop is closed. Right loops, of at most some metres, are green, wrong ones red;
    without a distance all are blue.

    If there are poses ``(N, 3)``, x and y in metres and heading, NaN where unknown, each sequence
    is drawn from above, with a dot at each frame that closes a loop and a line to its candidate. A
    second chart shows the numbers of such frames against those of their candidates, or the names of
    several sequences: a stretch that is driven again is a rising line.
    """
    here = np.flatnonzero(loops >= 0)
    there = loops[here]
    placed = bool(np.isfinite(poses[:, :2]).all(axis=1).any())
    figure = new_figure(10 if placed else 5, 5)
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    count = f"{len(here)} of {len(loops)} frames close a loop"
    figure.suptitle(f"{drawn_text(title)}\n{count}", wrap=True)
    axes = figure.subplots(1, 2 if placed else 1, squeeze=False)[0]
    if placed:
        draw_trajectory(axes[0], poses, sequences or [""] * len(poses), "trajectory")
    groups = [("loops", _UNJUDGED, np.full(len(here), True))]
    if metres is not None:
        right = np.hypot(*(poses[here, :2] - poses[there, :2]).T) <= metres
        groups = [
            (f"right, within {metres:g} m", _RIGHT, right),
            ("wrong, or of unknown pose", _WRONG, ~right),
        ]
    for name, colour, chosen in groups:
        if placed and chosen.any():
            lines = np.stack((poses[here[chosen], :2], poses[there[chosen], :2]), axis=1)
            axes[0].add_collection(LineCollection(list(lines), colors=colour, lw=0.8, alpha=0.7))
            axes[0].plot(*lines[:, 0].T, ".", ms=4, color=colour)
        label = f"{name}: {np.count_nonzero(chosen)}"
        axes[-1].plot(here[chosen], there[chosen], ".", ms=4, color=colour, label=label)
    if candidates is not None:
        faint = np.flatnonzero((candidates >= 0) & (loops < 0))
        label = f"candidates below the threshold: {len(faint)}"
        axes[-1].plot(faint, candidates[faint], ".", ms=2, color=GRAY, zorder=1, label=label)
    ends = (0, max(1, len(loops)))
    axes[-1].plot(ends, ends, color=GRAY, lw=0.8, zorder=0, label="the frame itself")
    axes[-1].set(xlabel="number of the frame", ylabel="number of its candidate")
    axes[-1].set(xlim=ends, ylim=ends, aspect="equal")
    names = list(runs(sequences or []))
    if len(names) > 1:
        for run in names:
            axes[-1].axvline(run.start, color=GRAY, lw=0.5, zorder=0)
            axes[-1].axhline(run.start, color=GRAY, lw=0.5, zorder=0)
        middles = [(run.start + run.stop) / 2 for run in names]
        labels = [drawn_text((sequences or [])[run.start]) for run in names]
        axes[-1].set(xlabel="frame, by its sequence", ylabel="its candidate, by its sequence")
        axes[-1].set_xticks(middles, labels)
        axes[-1].set_yticks(middles, labels, rotation=90, va="center")
    axes[-1].legend(loc="upper left", frameon=False)
    if placed:
        label = "frame, and line to its candidate"
        loop = Line2D([], [], marker=".", color=DARK, lw=0.8, label=label)
        handles, at = [*axes[0].get_legend_handles_labels()[0], loop], (0.5, -0.12)
        below = {"loc": "upper center", "bbox_to_anchor": at, "ncols": 3, "frameon": False}
        axes[0].legend(handles=handles, **below)
    return figure
