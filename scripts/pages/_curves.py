"""The figure of precision over recall, a panel for each condition."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from _decide import Decisions
from _described import IMAGES, LABELS, Condition
from _markdown import save
from _trials import Outcomes
from matplotlib.figure import Figure

from ssrvlad_torch.evaluation.metrics import Convention

COLOURS = (
    *("#8c564b", "#7f7f7f", "#bcbd22", "#17becf", "#d62728", "#ff9896"),
    *("#1f77b4", "#aec7e8", "#2ca02c", "#9467bd", "#e377c2"),
)
COLUMNS = 2
"""Panels beside each other, so that text is readable in a page."""

Panel = tuple[str, dict[str, Decisions]]
"""A title, and the outcomes of the methods."""


def draw(
    conditions: Sequence[Condition],
    outcomes: Outcomes,
    names: Sequence[str],
    convention: Convention,
    path: Path,
) -> None:
    """Curves of methods by a convention above, areas below: a panel for each condition that has
    label maps, and for images that have no such other; methods on images beside methods on
    labels."""
    panels = _panels(conditions, outcomes, names)
    colours = dict(zip(names, COLOURS, strict=False))
    rows = math.ceil(len(panels) / COLUMNS)
    figure = Figure(figsize=(4 * COLUMNS, 6.2 * rows), layout="constrained")
    axes = figure.subplots(2 * rows, COLUMNS, height_ratios=(3, 2) * rows)
    places = axes.reshape(rows, 2, COLUMNS).swapaxes(1, 2).reshape(-1, 2)
    for unused in places[len(panels) :].flat:
        unused.set_axis_off()
    for (title, found), (above, below) in zip(panels, places, strict=False):
        curves = {name: decisions.curve(convention) for name, decisions in found.items()}
        above.set_title(title, fontsize=10)
        for name, curve in curves.items():
            recall = np.concatenate((0 * curve.recall[:1], curve.recall))
            precision = np.concatenate((curve.precision[:1], curve.precision))
            above.plot(recall, precision, color=colours[name], lw=1.4)
        above.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
        above.grid(lw=0.3)
        areas = [float(curve.auc) for curve in curves.values()]
        bars = below.barh(np.arange(len(areas)), areas, color=[colours[name] for name in curves])
        below.bar_label(bars, fmt="%.3f", padding=3, fontsize=8)
        below.set(xlim=(0, 1.15), xticks=np.arange(6) / 5, yticks=[], xlabel="AUC")
        below.invert_yaxis()
    drawn = {name for _, found in panels for name in found}
    lines = [axes[0, 0].plot([], color=colours[n], label=n)[0] for n in names if n in drawn]
    figure.legend(handles=lines, loc="outside upper center", ncols=4, fontsize=9, frameon=False)
    save(figure, path)


def _panels(
    conditions: Sequence[Condition], outcomes: Outcomes, names: Sequence[str]
) -> list[Panel]:
    panels = []
    labelled = {each.dataset for each in conditions if each.gives == LABELS}
    for condition in conditions:
        if condition.gives == IMAGES and condition.dataset in labelled:
            continue
        of = [c for c in conditions if c.dataset == condition.dataset and c.gives == IMAGES]
        keys = [(each.title, name) for name in names for each in (condition, *of)]
        found = {key[1]: outcomes[key] for key in keys if isinstance(outcomes.get(key), Decisions)}
        panels.append((f"{condition.dataset}\n{condition.name}", found))
    return panels
