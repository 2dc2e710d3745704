#!/usr/bin/env python3
"""Writes docs/results.md and docs/results.csv: both presets, the features of networks, both
together with HOG, and five baselines on every data set, with and without the steps after the
descriptor.

    .venv/bin/python scripts/pages/results.py --data ../shared/data

The data sets are those of `_described.py`. On one thread, describing takes about two hours, most of
it for CoHOG and LoST-X. Descriptors are cached in `--cache`. The page takes ten minutes more.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import torch
from _decide import FIGURES, decide
from _described import (
    ALONE,
    METHODS,
    OF_NETWORKS,
    OURS,
    Condition,
    Described,
    all_conditions,
)
from _markdown import DOCS, ROOT, Page, first_table, head_row, parser, quote, row, save
from _sure_cases import add_new, new_pairs, of
from conditions import NETWORKS, Search
from matplotlib.figure import Figure

from ssrvlad_torch.files import replacing
from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps

WAYS = {"single frames": AS_PAPER, "with the steps": Steps()}
DATASETS = ("City", "CamVid", "UofA", "Gardens Point", "CMU Seasons", "Nordland")
MONTHS = {"oct2010_c1": "October", "jul2011_c1": "July", "apr2011_c1": "April"}
GRID = "label grid"
SHADES = (
    *("#7f7f7f", "#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e"),
    *("#17becf", "#bcbd22", "#000000"),
)
COLOURS = dict(zip(METHODS, SHADES, strict=True))

Row = dict[str, tuple[float, float, float]]
Measured = dict[tuple[str, str, str, str], Row]
"""Figures by data set, condition, method and way."""


def main() -> None:
    options = parser(__doc__, "results.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    measured = measure(described)
    page, folder = Page("results.md", options.output), options.output.parent
    fill(page, measured, folder / "figures")
    write_csv(folder / "results.csv", measured)
    if options.output.resolve().parent == DOCS:
        quote(ROOT / "README.md", "results", excerpt(page.text))


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


def measure(described: Described) -> Measured:
    measured: Measured = {}
    for condition in conditions_of(described):
        for method, way in product(filter(condition.suits, METHODS), WAYS):
            alone = way == "single frames" and method in OF_NETWORKS
            found = decide(described, condition, method, ALONE if alone else WAYS[way])
            measured[condition.dataset, condition.name, method, way] = found.figures()
        print(condition.title, flush=True)
    return measured


def fill(page: Page, measured: Measured, figures: Path) -> None:
    """The table of the page, its list of conditions, and its figures."""
    datasets = [name for name in DATASETS if any(key[0] == name for key in measured)]
    page.table("## In short\n", summary(measured, datasets))
    page.paragraph("- *single frames*: ", "\n".join(against_the_grid(measured)))
    for dataset in datasets:
        name = f"results-{dataset.lower().replace(' ', '-')}"
        draw(measured, dataset, figures / f"{name}.png")


def summary(measured: Measured, datasets: Sequence[str]) -> Iterator[str]:
    """RecallRate@1 and AUC-PR, the means over the conditions of each data set."""
    yield from head_row("method", *datasets)
    for method, way in product(METHODS, WAYS):
        cells = (in_short(measured, dataset, method, way) for dataset in datasets)
        yield row(f"{method}, {way}", *cells)


def in_short(measured: Measured, dataset: str, method: str, way: str) -> str:
    found = [row for key, row in measured.items() if key[0] == dataset and key[2:] == (method, way)]
    if not found:
        return "-"
    rate, area = (np.mean([row[name][0] for row in found]) for name in ("RecallRate@1", "AUC-PR"))
    return f"{rate:.3f} ({area:.3f})"


def against_the_grid(measured: Measured) -> Iterator[str]:
    """Where the trivial baseline is better with the same steps."""
    for way in WAYS:
        both = {
            key[:2]: (found["RecallRate@1"][0], measured[*key[:2], GRID, way]["RecallRate@1"][0])
            for key, found in measured.items()
            if key[2:] == (OURS, way)
        }
        worse = [
            f"{dataset}, {name}: {ours:.3f} against {grid:.3f}"
            for (dataset, name), (ours, grid) in both.items()
            if ours < grid - 1 / 300
        ]
        yield f"- *{way}*: {len(worse)} of {len(both)}"
        yield from (f"    - {condition}" for condition in worse)


def draw(measured: Measured, dataset: str, path: Path) -> None:
    """RecallRate@1 with its interval, one line per condition; hollow points for single frames."""
    names = list(dict.fromkeys(key[1] for key in measured if key[0] == dataset))
    shown = [m for m in METHODS if any(key[0] == dataset and key[2] == m for key in measured)]
    figure = Figure(figsize=(9, 1.4 + 0.13 * len(names) * (len(shown) + 1)), layout="constrained")
    axes = figure.subplots()
    for place, method in enumerate(shown):
        for way in WAYS:
            keys = [(dataset, name, method, way) for name in names]
            rates = [measured[key]["RecallRate@1"] for key in keys if key in measured]
            at = np.array([number for number, key in enumerate(keys) if key in measured])
            height = at + (place - (len(shown) - 1) / 2) / (len(shown) + 1.5)
            middle, low, high = np.array(rates).T
            colour, hollow = COLOURS[method], way == "single frames"
            points = {"mfc": "white"} if hollow else {"mfc": colour, "label": method}
            axes.hlines(height, low, high, color=colour, lw=1, alpha=0.6)
            axes.plot(middle, height, "o", ms=3.5, mec=colour, **points)
    axes.set(xlim=(-0.01, 1.01), xlabel="RecallRate@1 (hollow: single frames)")
    axes.set_yticks(np.arange(len(names)), names, fontsize=8)
    axes.set_ylim(len(names) - 0.45, -0.55)
    axes.hlines(np.arange(1, len(names)) - 0.5, 0, 1, color="#dddddd", lw=0.5)
    axes.grid(axis="x", lw=0.3)
    figure.legend(loc="outside upper center", ncols=6, fontsize=8, frameon=False)
    save(figure, path)


def write_csv(path: Path, measured: Measured) -> None:
    ends = (f"{name} {end}".strip() for name in FIGURES for end in ("", "low", "high"))
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["data set", "condition", "method", "way", *ends])
        for key, found in measured.items():
            table.writerow([*key, *(f"{value:.4f}" for name in FIGURES for value in found[name])])


def excerpt(page: str) -> str:
    """The summary of a results page, without AUC-PR."""
    cells, *rows = first_table(page, "## In short")
    shown = [*head_row(*cells), *(row(*(cell.partition(" (")[0] for cell in one)) for one in rows)]
    return "\n".join(["", *shown, ""])


if __name__ == "__main__":
    main()
