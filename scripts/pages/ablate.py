#!/usr/bin/env python3
"""Writes docs/ablation.md: the preset `default` with one setting changed at a time.

    .venv/bin/python scripts/pages/ablate.py --data ../shared/data

The folder and the conditions are those of `shape.py`. Results are cached, so an interrupted run
can be resumed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import steps
import torch
from _halves import GROUPS, GROUPS_IN_WORDS, HALVES, WAYS, measured
from _markdown import head_row, row, write
from conditions import Describe, described_by, described_by_baseline

from ssrvlad_torch import SSRVLADConfig
from ssrvlad_torch.files import replacing

SETTINGS: dict[str, list[Any]] = {
    "working_size": [None, 240, 90, 60],
    "anchor": ["middle"],
    "rings": [5, 8],
    "sectors": [12, 24],
    "inner_radius": [1 / 8, 1 / 12],
    "harmonics": [32, 48, 80, 114],
    "boundary_harmonics": [1, 12, 36, 48],
    "spectral_weight": [0.0, 0.5, 1.5],
    "power": [0.5, 1.0],
}
OF_THE_LAYERS = "working_size"
"""The only setting that changes the layers; for the others they are computed once."""

HEAD = f"""# Ablation

Written by `scripts/pages/ablate.py`. Each row is the preset `default` with one setting changed.
The numbers are RecallRate@1, the mean over the conditions of a group:

{GROUPS_IN_WORDS}
Each condition has two halves; the table shows the half that was not used to choose settings.

- *standardised*: single frames, after the mean of each traverse is subtracted.
- *followed*: the same frames found as a sequence, online (from the queries so far).

[ablation.csv](ablation.csv) also has the other halves and raw frames. [Shape](shape.md) compares
the parts of the descriptor.

![](figures/ablation.svg)
"""

READING = """## Conclusions

- Most changes gain in one column and lose in another. A column has a few hundred queries, so
  differences of 0.02 mean little.
- Clearly worse are the residuals of the paper, the middle of the picture as anchor if the camera
  turns or moves aside, an anchor at the centre of each layer, and few numbers for the boundaries.
"""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, required=True)
    arguments.add_argument("--output", type=Path, default=Path("docs/ablation.md"))
    arguments.add_argument("--cache", type=Path, default=Path(".cache/shape"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    found = measured(dict(ways()), options.data, options.cache)
    draw(found, options.output.parent / "figures" / "ablation.svg")
    with replacing(options.output.with_suffix(".csv")) as temporary:
        temporary.write_text("".join(table(found)), encoding="utf-8")
    write(options.output, "\n".join(page(found)) + "\n")


def ways() -> Iterator[tuple[str, Describe]]:
    """Ways to describe, by name."""
    yield "default", described_by(SSRVLADConfig())
    yield "paper", described_by(SSRVLADConfig.from_preset("paper"))
    yield "label grid", described_by_baseline("label-grid")
    for name, values in SETTINGS.items():
        for value in values:
            changed = SSRVLADConfig.from_preset("default", **{name: value})
            made = described_by if name == OF_THE_LAYERS else steps.harmonics
            text = f"{value:.3f}" if isinstance(value, float) else value
            yield f"{name} = {text}", made(changed)
    yield from steps.REJECTED.items()


def page(found: dict[str, dict[str, list[float]]]) -> Iterator[str]:
    yield HEAD
    yield READING
    yield from head_row("", *(f"{group}, {way}" for way in WAYS[1:] for group in GROUPS))
    for name, rates in found.items():
        cells = [rates[f"{group}, {HALVES[1]}"][way] for way in (1, 2) for group in GROUPS]
        yield row(name, *(f"{cell:.3f}" for cell in cells))
    yield ""


def table(found: dict[str, dict[str, list[float]]]) -> Iterator[str]:
    """Lines of CSV."""
    yield f"line,group,half,{','.join(WAYS)}\n"
    for name, rates in found.items():
        for of, values in rates.items():
            group, half = of.split(", ")
            yield f'"{name}",{group},{half},{",".join(f"{value:.4f}" for value in values)}\n'


def draw(found: dict[str, dict[str, list[float]]], path: Path) -> None:
    """Plots RecallRate@1 of every row on the other halves, by group."""
    from matplotlib.figure import Figure

    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9, 0.22 * len(found) + 1), layout="constrained")
    for axes, way in zip(figure.subplots(1, 2, sharey=True), (1, 2), strict=True):
        for group in GROUPS:
            rates = [of[f"{group}, {HALVES[1]}"][way] for of in found.values()]
            (dots,) = axes.plot(rates, np.arange(len(rates)), "o", label=group)
            axes.axvline(rates[0], color=dots.get_color(), lw=0.8, ls=":")
        axes.set_yticks(range(len(found)), list(found), fontsize=8)
        axes.set_xlabel(f"RecallRate@1, {WAYS[way]}; dotted: default")
        axes.grid(axis="y", lw=0.3)
    axes.invert_yaxis()
    axes.legend(loc="lower left")
    with replacing(path) as temporary:
        figure.savefig(temporary, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
