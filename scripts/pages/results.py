#!/usr/bin/env python3
"""Writes docs/evaluation/results.csv and what pages show of it: both presets, the features of
networks, both together with HOG, and five baselines on every data set, with and without the steps
after the descriptor.

    .venv/bin/python scripts/pages/results.py --data ../shared/data

The data sets are those of `_described.py`. On one thread, describing takes about two hours, most of
it for CoHOG and LoST-X. Descriptors are cached in `--cache`. The rest takes ten minutes more.
--shown shows the CSV file again, without measuring; --method measures some methods anew and keeps
the rows of the others.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import torch
from _decide import FIGURES, decide
from _described import (
    ALONE,
    FEATURES,
    METHODS,
    OF_NETWORKS,
    OURS,
    TOGETHER,
    Condition,
    Described,
    all_conditions,
)
from _markdown import DOCS, Page, head_row, parser, read_csv, row, save
from _real_pairs import add_new, new_pairs, of
from conditions import NETWORKS, Search
from matplotlib.figure import Figure

from ssrvlad_torch.files import replacing
from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps

WAYS = {"single frames": AS_PAPER, "with the steps": Steps()}
DATASETS = ("City", "CamVid", "UofA", "Gardens Point", "CMU Seasons", "Nordland")
MONTHS = {"oct2010_c1": "October", "jul2011_c1": "July", "apr2011_c1": "April"}
GRID = "label grid"
SHIPPED = (OURS, FEATURES, TOGETHER)
NAMES = {
    TOGETHER: "together (default of encode)",
    OURS: "label maps (SSR-VLAD, default)",
    "label grid": "label grid (baseline)",
    "HOG": "HOG (baseline, a channel)",
    "tiny image": "tiny image (baseline)",
}

Rows = list[dict[str, str]]
Row = dict[str, tuple[float, float, float]]
Measured = dict[tuple[str, str, str, str], Row]
"""Figures by data set, condition, method and way."""


def main() -> None:
    arguments = parser(__doc__, "evaluation/results.md", "described", needs_data=False)
    arguments.add_argument("--shown", action="store_true")
    arguments.add_argument("--method", action="append", choices=METHODS, help="repeatable; all")
    options = arguments.parse_args()
    torch.set_num_threads(1)
    page = Page("evaluation/results.md", options.output, whole=not options.shown)
    table = options.output.parent / "results.csv"
    if not options.shown:
        methods = options.method or METHODS
        measured = measure(Described(options.data, options.cache), methods)
        write_figures(table, measured, [] if methods == METHODS else read_csv(table))
    rows = read_csv(table)
    page.show("results", ["", *summary(rows), ""])
    page.show("label grid", [against_the_grid(rows)])
    draw(rows, DOCS / "figures" / "results.svg")


def conditions_of(described: Described) -> Iterator[Condition]:
    """All conditions, and last the places on which nothing was chosen."""
    yield from all_conditions(described)
    if not described.data:
        return
    add_new(described)
    for network, dataset in product(NETWORKS, DATASETS[-2:]):
        for later, earlier, truth in new_pairs(described, network):
            folder = dataset.lower().replace(" seasons", "_schenley")
            if later.startswith(folder):
                names = [path.partition("/")[2] for path in (later, earlier)]
                name = " -> ".join(MONTHS.get(each, each) for each in names)
                search = Search(of(network, later), of(network, earlier), list(truth))
                yield Condition(dataset, f"{name}, {network}", [search])


def measure(described: Described, methods: Sequence[str]) -> Measured:
    measured: Measured = {}
    for condition in conditions_of(described):
        for method, way in product(filter(condition.suits, methods), WAYS):
            alone = way == "single frames" and method in OF_NETWORKS
            found = decide(described, condition, method, ALONE if alone else WAYS[way])
            measured[condition.dataset, condition.name, method, way] = found.figures()
        print(condition.title, flush=True)
    return measured


def write_figures(path: Path, measured: Measured, earlier: Rows) -> None:
    """The CSV file of all figures with their intervals; what was not measured is as before."""
    ends = (f"{name} {end}".strip() for name in FIGURES for end in ("", "low", "high"))
    lines = {tuple(line.values())[:4]: list(line.values()) for line in earlier}
    for key, found in measured.items():
        lines[key] = [*key, *(f"{value:.4f}" for name in FIGURES for value in found[name])]
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["data set", "condition", "method", "way", *ends])
        table.writerows(lines.values())


def rate(rows: Rows, dataset: str, method: str, way: str) -> float:
    """The mean RecallRate@1 over the conditions of a data set; NaN without any."""
    chosen = {"data set": dataset, "method": method, "way": way}
    rates = [float(row["RecallRate@1"]) for row in rows if chosen.items() <= row.items()]
    return float(np.mean(rates)) if rates else math.nan


def summary(rows: Rows) -> Iterator[str]:
    """A line for each method and way."""
    yield from head_row("method", *DATASETS)
    for method, way in product(METHODS, WAYS):
        rates = (rate(rows, dataset, method, way) for dataset in DATASETS)
        yield row(f"{method}, {way}", *("-" if math.isnan(r) else f"{r:.3f}" for r in rates))


def against_the_grid(rows: Rows) -> str:
    """In how many conditions the trivial baseline is better with the same steps."""
    rates = {
        (row["method"], row["way"], row["data set"], row["condition"]): float(row["RecallRate@1"])
        for row in rows
    }
    worse = [
        (sum(rates[OURS, *at] < rates[GRID, *at] - 1 / 300 for at in ats), len(ats))
        for ats in ([key[1:] for key in rates if key[:2] == (OURS, way)] for way in WAYS)
    ]
    parts = (f"in {n} of {of} conditions ({way})" for (n, of), way in zip(worse, WAYS, strict=True))
    return f"by more than one query of 300 {' and '.join(parts)}"


def draw(rows: Rows, path: Path) -> None:
    """Bars of RecallRate@1, the mean over the real data sets; the best method comes first."""
    real = DATASETS[1:]
    means = {
        method: [np.mean([rate(rows, d, method, way) for d in real]) for way in WAYS]
        for method in METHODS
    }
    methods = sorted(means, key=lambda method: means[method][1])
    figure = Figure(figsize=(7.5, 3.6), layout="constrained")
    axes, at = figure.subplots(), np.arange(len(methods))
    colours = ["#1f77b4" if method in SHIPPED else "#8a8a8a" for method in methods]
    for number, (way, strength) in enumerate(zip(WAYS, (0.45, 1.0), strict=True)):
        values = [means[method][number] for method in methods]
        bars = axes.barh(at + 0.2 - 0.4 * (1 - number), values, 0.4, color=colours)
        for bar in bars:
            bar.set_alpha(strength)
        axes.bar_label(bars, [f" {value:.2f} {way}" for value in values], fontsize=7)
    axes.set_yticks(at, [NAMES.get(method, method) for method in methods], fontsize=9)
    axes.set(xlim=(0, 1.25), xlabel="fraction of queries whose first answer is the right place")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xticks(np.arange(0, 1.1, 0.2))
    save(figure, path)


if __name__ == "__main__":
    main()
