"""A picture of the loops of a stream. It needs the extra ``eval`` (matplotlib)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..evaluation.outcomes import Floats, Rows
from ..files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RIGHT, _WRONG, _UNJUDGED = "tab:green", "tab:red", "tab:blue"


def require_picture(path: Path) -> None:
    """Refuses what `draw_loops` would refuse, before the frames are there.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: no such picture format.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need: pip install ssrvlad-torch[eval]") from error
    formats = Figure().canvas.get_supported_filetypes()
    if _form(path) not in formats:
        raise ValueError(f"{path}: a picture is one of {', '.join(formats)}")


def draw_loops(
    path: Path, loops: Rows, poses: Floats, title: str, metres: float | None = None
) -> None:
    """Writes a picture of a stream.

    Where there are poses, the trajectory is drawn from above with a line from each frame that
    closes a loop to its candidate. Beside it stands, for each such frame, the number of the frame
    and of its candidate: a stretch that is driven again is a rising line, one that is driven back
    a falling one.

    Args:
        path: the picture; its suffix says the format (``.png``, ``.svg``, ``.pdf``).
        loops: ``(N,)`` int64, row of each frame's candidate, -1 where it closes no loop.
        poses: ``(N, 3)`` x and y in metres and heading, NaN where unknown.
        title: stands above.
        metres: loops of frames that are farther apart are drawn red, others green; without,
            all are blue.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: no such picture format.
        OSError: the picture cannot be written.
    """
    require_picture(path)
    from matplotlib.figure import Figure

    here = np.flatnonzero(loops >= 0)
    there = loops[here]
    apart = np.hypot(*(poses[here, :2] - poses[there, :2]).T)
    judged = {_UNJUDGED: np.full(len(here), True)}
    if metres is not None:
        judged = {_RIGHT: apart <= metres, _WRONG: ~(apart <= metres)}
    placed = bool(np.isfinite(poses[:, :2]).all(axis=1).any())
    figure = Figure(figsize=(13, 6) if placed else (6.5, 6), layout="constrained")
    figure.suptitle(f"{title}: {len(here)} of {len(loops)} frames close a loop")
    axes = figure.subplots(1, 2 if placed else 1, squeeze=False)[0]
    for colour, chosen in judged.items():
        if placed:
            _draw_loops_from_above(axes[0], poses, here[chosen], there[chosen], colour)
        axes[-1].plot(here[chosen], there[chosen], ".", ms=4, color=colour)
    if placed:
        _draw_trajectory(axes[0], poses)
    ends = (0, max(1, len(loops)))
    axes[-1].plot(ends, ends, color="0.8", lw=0.8, zorder=0)
    axes[-1].set(xlabel="frame", ylabel="candidate", xlim=ends, ylim=ends)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=_form(path))


def _form(path: Path) -> str:
    return path.suffix.removeprefix(".").lower() or "png"


def _draw_trajectory(axes: Axes, poses: Floats) -> None:
    axes.plot(poses[:, 0], poses[:, 1], color="0.6", lw=1, zorder=0)
    known = np.flatnonzero(np.isfinite(poses[:, :2]).all(axis=1))
    axes.plot(*poses[known[0], :2], "o", color="black", ms=5, label="start")
    axes.set(xlabel="x in metres", ylabel="y in metres")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="upper right", frameon=False)


def _draw_loops_from_above(axes: Axes, poses: Floats, here: Rows, there: Rows, colour: str) -> None:
    from matplotlib.collections import LineCollection

    lines = np.stack((poses[here, :2], poses[there, :2]), axis=1)
    axes.add_collection(LineCollection(list(lines), colors=colour, lw=0.8, alpha=0.7))
    axes.plot(poses[here, 0], poses[here, 1], ".", ms=4, color=colour)
