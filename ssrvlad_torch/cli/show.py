"""A picture of what the method sees in one frame. It needs the extra ``eval`` (matplotlib)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from ..config import AREA_LAYERS
from ..datasets.label_files import LabelMap
from ..descriptor import SSRVLAD
from ..explanation import Explanation
from ..files import check_output, replacing
from ..stages.harmonics import HarmonicHistograms
from ..taxonomy import CATEGORIES, colourise

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 4
_COUNTED_AS = {AREA_LAYERS: 2, AREA_LAYERS + 1: 0}
_ARC_STEPS = 10
_LAYER_COLOURS = (
    "#b58bb5",
    "#f5a3ee",
    "#a9a9a9",
    "#e3c770",
    "#a9c97b",
    "#9cc4e4",
    "#cdbccd",
    "#fac8be",
)


def draw(labels: LabelMap, head: SSRVLAD, path: Path, title: str) -> None:
    """Writes a picture of one frame.

    On the left stands the label map. For each category follow its clean layer with skeleton, end
    points, intersections and centre, and the vanishing column where there is one. Under it stands
    the layer's histogram as a target: rings by distance, sectors by direction. For residuals red
    is where the keypoints see more skeleton than the centre does, and blue where they see less.
    For harmonics red is the area of the layer, for guard rail and parking that of the layer which
    they are counted as.

    Args:
        labels: ``(H, W)`` integer ids of the head's label space.
        head: the method.
        path: the picture; its suffix says the format (``.png``, ``.svg``, ``.pdf``).
        title: stands above the label map.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: the labels do not fit the label space, or no such picture format.
        OSError: the picture cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need: pip install ssrvlad-torch[eval]") from error
    check_output(path)
    view = head.explain(torch.from_numpy(labels.astype(np.int64))[None])
    figure = Figure(figsize=(17, 9), layout="constrained")
    halves = figure.add_gridspec(1, 2, width_ratios=(1, 1.7))
    left = halves[0].subgridspec(2, 1, height_ratios=(3, 1))
    _draw_labels(figure.add_subplot(left[0]), labels, head, title)
    _draw_key(figure.add_subplot(left[1]), view)
    grid = halves[1].subgridspec(2 * len(CATEGORIES) // _COLUMNS, _COLUMNS)
    for k, category in enumerate(CATEGORIES):
        row, column = divmod(k, _COLUMNS)
        _draw_layer(figure.add_subplot(grid[2 * row, column]), view, k, category)
        _draw_vector(figure.add_subplot(grid[2 * row + 1, column], polar=True), view, k)
    form = path.suffix.removeprefix(".") or "png"
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=form)


def _draw_labels(axes: Axes, labels: LabelMap, head: SSRVLAD, title: str) -> None:
    axes.imshow(colourise(labels, head.label_space))
    axes.set_title(f"{title}: {labels.shape[0]} x {labels.shape[1]}, {head.label_space.name}")
    axes.set_axis_off()


def _draw_key(axes: Axes, view: Explanation) -> None:
    from matplotlib.lines import Line2D

    if not isinstance(view.histograms, HarmonicHistograms):
        targets = [
            _marker("o", "#b2182b", "target: keypoints see more skeleton than the centre", 10),
            _marker("o", "#2166ac", "target: they see less (Eq. 2)", 10),
        ]
    else:
        targets = [
            Line2D([], [], color="tab:red", ls="--", label="vanishing column"),
            _marker("o", "#b2182b", "target: area around the vanishing column", 10),
        ]

    entries = [
        Line2D([], [], color="black", lw=1.5, label="skeleton"),
        _marker("o", "tab:red", "end point"),
        _marker("s", "tab:blue", "intersection"),
        _marker("*", "gold", "centre of the layer (Eq. 1)", size=14),
        *targets,
    ]
    axes.legend(handles=entries, loc="upper left", frameon=False, fontsize=11)
    axes.set_axis_off()


def _marker(shape: str, colour: str, label: str, size: float = 6) -> Any:
    from matplotlib.lines import Line2D

    return Line2D(
        [], [], ls="", marker=shape, mfc=colour, mec="black", mew=0.5, ms=size, label=label
    )


def _draw_layer(axes: Axes, view: Explanation, k: int, category: str) -> None:
    from matplotlib.colors import ListedColormap

    clean, skeleton = view.clean_layers[0, k], view.skeleton[0, k]
    picture = clean.int() + skeleton
    colours = ListedColormap(["white", _LAYER_COLOURS[k], "black"])
    axes.imshow(picture.numpy(), cmap=colours, vmin=0, vmax=2, interpolation="nearest")
    for mask, shape, colour in (
        (view.end_points, "o", "tab:red"),
        (view.intersections, "s", "tab:blue"),
    ):
        y, x = mask[0, k].numpy().nonzero()
        axes.plot(x, y, shape, mfc=colour, mec="black", mew=0.4, ms=4)
    if isinstance(view.histograms, HarmonicHistograms):
        column = (clean.shape[1] - 1) / 2 + int(view.histograms.column[0])
        axes.axvline(column, color="tab:red", ls="--", lw=1)
    y, x = view.centres[0, k].tolist()
    if y >= 0:
        axes.plot(x, y, "*", mfc="gold", mec="black", mew=0.6, ms=12)
    points = int(view.keypoints[0, k].sum())
    axes.set_title(f"{category}: {points} keypoints" if y >= 0 else f"{category}: none", size=10)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_vector(axes: Axes, view: Explanation, k: int) -> None:
    vector = _target(view, k)
    rings, sectors = vector.shape
    angles = np.linspace(0, 2 * np.pi, sectors * _ARC_STEPS + 1)
    arcs = vector.repeat(_ARC_STEPS, axis=1)
    scale = max(1e-9, np.abs(vector).max())
    axes.pcolormesh(angles, np.arange(rings + 1), arcs, cmap="RdBu_r", vmin=-scale, vmax=scale)
    axes.set_theta_direction(-1)  # type: ignore[attr-defined]
    if isinstance(
        view.histograms, HarmonicHistograms
    ):  # a soft sector lies around its angle, not after it
        axes.set_theta_offset(np.pi / sectors)  # type: ignore[attr-defined]
    axes.set_xticks(angles[:-1:_ARC_STEPS], [])
    axes.set_yticks(np.arange(1, rings + 1), [])
    axes.grid(lw=0.3, color="gray")


def _target(view: Explanation, k: int) -> npt.NDArray[Any]:
    """``(N, M)``, what the layer's target shows."""
    found = view.histograms
    if isinstance(found, HarmonicHistograms):
        return np.asarray(found.bins[0, _COUNTED_AS.get(k, k)])
    return np.asarray(found.points[0, k] - found.counts[0, k] * found.centre[0, k])
