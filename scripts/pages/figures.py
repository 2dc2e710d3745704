"""Draws the figures of pages that are no measurement, into docs/figures:

    .venv/bin/python scripts/pages/figures.py [--data ../shared/data] [--only pipeline]

`stages` is a frame of the synthetic city as `ssrvlad show` draws it, `overview` two sequences
through the city, matched; `sequences`, which needs `--data`, the similarity of an evening to a day
and the path through it; `pipeline` a diagram.
"""

from __future__ import annotations

import argparse
from itertools import starmap
from pathlib import Path

import numpy as np
import torch
from _markdown import DOCS, save
from conditions import real
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.channels.hog import HOG
from ssrvlad_torch.config import PRESETS
from ssrvlad_torch.datasets.synthetic_city import REFERENCE, TOUR, Conditions, SyntheticCity
from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps, recognise, references_of
from ssrvlad_torch.recognition.sweep import COLUMNS
from ssrvlad_torch.taxonomy import colourise

FIGURES = DOCS / "figures"
SPACE = "cityscapes-trainids"
FRAME = 4
"""The one whose stages are drawn."""

LATER = Conditions(spacing=2.7, lateral_offset=2.0, season="winter", noise=2.0, seed=1)
TOURED, PAIR, RIGHT, APART = 260, 150, 10.0, (22.0, -22.0)
GREEN, RED, BLUE, GRAY = "#2ca02c", "#d62728", "#1f77b4", "#8a8a8a"


def stages() -> None:
    *_, frame = SyntheticCity().traverse(FRAME + 1)
    for preset in PRESETS:
        view = SSRVLAD.from_preset(preset, labels_as=SPACE).explain(frame.labels[None])
        save(view.show(), FIGURES / f"stages-{preset}.png")


def overview() -> None:
    """Two sequences from above with a line from each query to its match, and one pair of frames."""
    head = SSRVLAD.from_preset("default", labels_as=SPACE)
    city = SyntheticCity(0)
    first, later = (
        list(city.traverse(TOURED, conditions, turns=TOUR)) for conditions in (REFERENCE, LATER)
    )
    maps, queries = (
        torch.cat([head.sweep(torch.from_numpy(f.labels[None]), COLUMNS) for f in frames])
        for frames in (first, later)
    )
    known = references_of({"ssr-vlad": maps[:, COLUMNS.index(0)]}, ["map"] * len(first))
    found = recognise({"ssr-vlad": queries}, ["later"] * len(later), known, Steps(), 1)
    rows = found.matches.indices[:, 0].tolist()
    here, there = (np.array([frame.pose[:2] for frame in frames]) for frames in (later, first))
    right = np.hypot(*(here - there[rows]).T) <= RIGHT
    lines = np.stack([here + APART, there[rows]], axis=1)
    figure = Figure(figsize=(9, 4), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(2, 1.2))
    above = figure.add_subplot(grid[:, 0])
    above.plot(*there.T, color=GRAY, lw=2.5, label="map: summer, known positions")
    above.plot(*(here + APART).T, color=BLUE, lw=2.5, label="queries: winter, drawn aside")
    colours = np.where(right, GREEN, RED)
    above.add_collection(LineCollection(lines, colors=colours, lw=0.6, alpha=0.7))
    above.plot([], [], color=GREEN, label=f"{right.sum()} right matches")
    above.plot([], [], color=RED, label=f"{(~right).sum()} wrong")
    above.set_aspect("equal")
    above.axis("off")
    above.legend(loc="center", bbox_to_anchor=(0.5, 0.53), fontsize=9, frameon=False)
    for place, (frame, name) in enumerate(
        (
            (later[PAIR], "a query: labels with errors of a network"),
            (first[rows[PAIR]], "its match in the map"),
        )
    ):
        axes = figure.add_subplot(grid[place, 1])
        axes.imshow(colourise(frame.labels, SPACE))
        axes.set_title(name, fontsize=9)
        axes.axis("off")
    save(figure, FIGURES / "overview.png")


def sequences(data: Path) -> None:
    """Similarities by HOG, with the answers to single frames and those by sequence matching."""
    evening, day = (
        HOG().describe([*real(data / "uofa" / name, "espnetv2").seen()])
        for name in ("evening", "day")
    )
    known = references_of({"hog": day}, ["day"] * len(day))
    similar = known.compare({"hog": evening.numpy()})[0]
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    ways = {"single frames": AS_PAPER, "sequence matching": Steps()}
    for axes, (name, steps) in zip(figure.subplots(1, 2), ways.items(), strict=True):
        found = recognise({"hog": evening}, ["evening"] * len(evening), known, steps, 1)
        rows = found.matches.indices[:, 0].numpy()
        right = np.abs(rows - np.arange(len(rows))) <= 1
        axes.imshow(similar, cmap="gray", vmin=np.quantile(similar, 0.05), aspect="equal")
        for some, colour in ((right, GREEN), (~right, RED)):
            axes.plot(rows[some], np.flatnonzero(some), ".", color=colour, ms=4)
        axes.set(title=f"{name}: {right.mean():.0%} right", xlabel="map frame, by day")
        axes.set_ylabel("query frame, in the evening")
    save(figure, FIGURES / "sequences.png")


BOXES = {
    "picture": (0, 1, "picture"),
    "network": (1.6, 1, "segmentation\nnetwork"),
    "labels": (3.2, 2, "label map"),
    "shapes": (4.9, 2, "descriptor\n480 numbers"),
    "features": (4.9, 1, "features\n32,768 signs"),
    "hog": (4.9, 0, "HOG\n480 numbers"),
    "search": (6.6, 1, "search\nin the map"),
    "sequence": (8.2, 1, "sequence\nmatching"),
    "answer": (9.8, 1, "place, pose,\nconfidence"),
}
"""Where the boxes of the diagram are, and what they say."""

ARROWS = (
    *(("picture", "network"), ("picture", "hog"), ("network", "labels"), ("network", "features")),
    *(("labels", "shapes"), ("shapes", "search"), ("features", "search"), ("hog", "search")),
    *(("search", "sequence"), ("sequence", "answer")),
)


def pipeline() -> None:
    figure = Figure(figsize=(10.5, 2.9), layout="constrained")
    axes = figure.subplots()
    for name, (x, y, words) in BOXES.items():
        colour = "#dbe9f6" if name in ("shapes", "features", "hog") else "#eeeeee"
        style = "round,pad=0.08"
        axes.add_patch(FancyBboxPatch((x, y - 0.25), 1.1, 0.5, style, fc=colour, ec=GRAY))
        axes.text(x + 0.55, y, words, ha="center", va="center", fontsize=9)

    def arrow(start: str, end: str) -> FancyArrowPatch:
        (x, y, _), (to_x, to_y, _) = BOXES[start], BOXES[end]
        begin = (x + 0.55, y - 0.35) if end == "hog" else (x + 1.2, y)  # below the network
        ends = begin, (to_x - 0.1, to_y)
        return FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=10, color=GRAY)

    for patch in starmap(arrow, ARROWS):
        axes.add_patch(patch)
    axes.set(xlim=(-0.2, 11.1), ylim=(-0.5, 2.5))
    axes.axis("off")
    save(figure, FIGURES / "pipeline.svg")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--only", nargs="+")
    options = parser.parse_args()
    drawn = {"stages": stages, "overview": overview, "pipeline": pipeline}
    for name, draw in drawn.items():
        if not options.only or name in options.only:
            draw()
    if options.data and (not options.only or "sequences" in options.only):
        sequences(options.data)


if __name__ == "__main__":
    main()
