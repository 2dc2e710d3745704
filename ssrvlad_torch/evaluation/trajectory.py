"""Sequences from above, in a chart."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from .curves import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GRAY, DARK = "0.7", "0.25"


def draw_trajectory(axes: Axes, poses: Floats, sequences: Sequence[str], name: str) -> None:
    """Draws each sequence of poses ``(N, 3)`` as a line of its own, with a square at its start;
    ``name`` is that of the lines in the legend."""
    shown = {name: True, "start": True}
    for _, group in groupby(range(len(poses)), lambda row: sequences[row]):
        rows = [*group]
        placed = [row for row in rows if np.isfinite(poses[row, :2]).all()]
        line = name if shown.pop(name, None) else None
        axes.plot(*poses[rows, :2].T, color=GRAY, lw=1, zorder=0, label=line)
        if placed:
            label = "start" if shown.pop("start", None) else None
            axes.plot(*poses[placed[0], :2], "s", color=DARK, ms=5, label=label)
    axes.set(xlabel="x in metres", ylabel="y in metres")
    axes.set_aspect("equal", adjustable="datalim")
