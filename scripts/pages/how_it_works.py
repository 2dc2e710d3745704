"""Draws docs/figures/stages.png, one frame of the synthetic city stage by stage, and demo.png.

python scripts/pages/how_it_works.py
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.cli.demo import run_demo
from ssrvlad_torch.config import CATEGORIES
from ssrvlad_torch.datasets.synthetic_city import write_city
from ssrvlad_torch.stages.boundaries import DIRECTIONS, boundaries
from ssrvlad_torch.stages.layers import merge
from ssrvlad_torch.taxonomy import colourise

SPACE = "cityscapes-trainids"
FRAMES = 100
"""Frames of each drive of the demo, as in `ssrvlad demo`."""

LAYER = 2
"""Buildings."""

_COLOURS = ((0.86, 0.2, 0.18), (0.12, 0.37, 0.7), (0.1, 0.55, 0.25), (0.9, 0.6, 0.1))
_PAPER, _OURS, *_ = _COLOURS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("docs/figures"))
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        city = write_city(Path(folder) / "city", frames=8)
        frame = sorted(city.reference.iterdir())[4]
        draw(np.asarray(Image.open(frame))).savefig(given.output / "stages.png", dpi=140)
        _, shown = run_demo(Path(folder) / "demo", FRAMES, 0, lambda _: None)
        shutil.copy(shown, given.output / "demo.png")


def draw(labels: np.ndarray) -> Figure:
    """Draws the stages of ``paper`` above those of ``default``."""
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    rows = figure.subplots(2, 4)
    given = torch.from_numpy(labels.astype(np.int64))[None]
    _paper(rows[0], labels, SSRVLAD.from_preset("paper", labels_as=SPACE), given)
    _default(rows[1], SSRVLAD.from_preset("default", labels_as=SPACE), given)
    return figure


def _paper(axes: Any, labels: np.ndarray, head: SSRVLAD, given: torch.Tensor) -> None:
    view = head.explain(given)
    clean, skeleton = view.clean_layers[0, LAYER].numpy(), view.skeleton[0, LAYER].numpy()
    ends, crossings = view.end_points[0, LAYER].numpy(), view.intersections[0, LAYER].numpy()
    _show(axes[0], colourise(labels, SPACE), "label map")
    _show(axes[1], _on_white(clean, (0.75, 0.75, 0.75)), f"{CATEGORIES[LAYER]}, cleaned")
    picture = _on_white(clean, (0.9, 0.9, 0.9))
    picture[skeleton] = _PAPER
    _show(axes[2], picture, "skeleton, end points,\nintersections, centre (Eq. 1)")
    for mask, mark in ((ends, "o"), (crossings, "s")):
        y, x = np.nonzero(mask)
        axes[2].plot(x, y, mark, color="black", markersize=4)
    y, x = view.centres[0, LAYER].tolist()
    axes[2].plot(x, y, "+", color=_OURS, markersize=14, markeredgewidth=3)
    vector = view.descriptor[0].view(len(CATEGORIES), -1)
    _bars(axes[3], vector, "paper: eight\nvectors of 60 (Eq. 2)", _PAPER)


def _default(axes: Any, head: SSRVLAD, given: torch.Tensor) -> None:
    view, layers = head.explain(given), head._front_end(given)
    _show(axes[0], _on_white(view.layers[0, LAYER].numpy(), (0.75, 0.75, 0.75)), "layer, 120 rows")
    runs = boundaries(merge(layers))[0].numpy()
    picture = np.ones((*runs.shape[1:], 3))
    for run, colour, direction in zip(runs, _COLOURS, DIRECTIONS, strict=True):
        picture[run == 1] = colour
        axes[1].plot([], [], color=colour, label=direction)
    _show(axes[1], picture, "boundaries in\nfour directions")
    axes[1].legend(fontsize=10, loc="upper left", bbox_to_anchor=(0, 0), ncols=2, frameon=False)
    _show(axes[2], np.ones((1, 1, 3)), "")
    bins = view.histograms.bins[0].flatten(1)
    axes[2].imshow(bins, aspect="auto", cmap="Greys", interpolation="nearest")
    axes[2].set_title("soft bins:\n6 areas, 4 directions", fontsize=12)
    vector = view.descriptor[0]
    area = vector[: 6 * head.config.harmonics].view(6, -1)
    lengths = vector[6 * head.config.harmonics :].view(4, -1)
    wide = torch.zeros(10, area.shape[1])
    wide[:6], wide[6:, : lengths.shape[1]] = area, lengths
    _bars(axes[3], wide, "default: coefficients\nof the smoothest waves", _OURS)


def _show(axes: Any, picture: np.ndarray, title: str) -> None:
    axes.imshow(picture, interpolation="nearest")
    axes.set_title(title, fontsize=12)
    axes.set_axis_off()


def _on_white(mask: np.ndarray, colour: tuple[float, float, float]) -> np.ndarray:
    picture = np.ones((*mask.shape, 3))
    picture[mask] = colour
    return picture


def _bars(axes: Any, rows: torch.Tensor, title: str, colour: tuple[float, float, float]) -> None:
    """Draws each row of numbers as a curve, the first on top."""
    step = 2.2 * float(rows.abs().max())
    for number, row in enumerate(rows.tolist()):
        axes.plot(np.array(row) - number * step, color=colour, linewidth=1.1)
    axes.set_title(title, fontsize=12)
    axes.set_axis_off()


if __name__ == "__main__":
    main()
