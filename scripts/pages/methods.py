#!/usr/bin/env python3
"""Writes docs/methods.md: input, cost and accuracy of every method.

    .venv/bin/python scripts/pages/methods.py --data ../shared/data

The folder holds `camvid` (see `_trials.py`), `networks`, and `vprbench/corridor` in the layout of
VPR-Bench. The accuracy on real traverses is read from docs/results.csv, see `results.py`.
Descriptors are cached in `--cache`, so an interrupted run can be resumed.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from statistics import mean, median

import _trials
from _costs import ENCODED
from _decide import FIGURES
from _described import IMAGES, OF_PICTURES, Described
from _markdown import Page, head_row, interval, paragraph, parser, processor, row, significant
from _timing import threads

from ssrvlad_torch.datasets.layouts import open_dataset

CORRIDOR = "Corridor"
PICTURES = 8
ROUNDS, ROUNDS_OF_NETWORKS = 40, 8
RIVALS = (
    *("SSR-VLAD, paper", "SSR-VLAD, default", "label grid", "HOG", "CoHOG"),
    *("NetVLAD", "Region-VLAD", "LoST-X", "features", "tiny image"),
)
TRAVERSES = ("UofA", "Gardens Point")

COSTS = f"""Costs on {{processor}}, at {{size}}: the median of {ROUNDS} frames
({ROUNDS_OF_NETWORKS} for networks with random weights); the methods take turns, and one that runs
again and again, with warm caches, takes less. [methods.csv](methods.csv) has minimum and maximum.
There are {{references}} references, for LoST-X and tiny image {ENCODED}."""


def main() -> None:
    arguments = parser(__doc__, "methods.md", "described")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    options = arguments.parse_args()
    network = options.data / "networks" / "espnetv2.yaml"
    described = Described(None, options.cache, {}, options.weights, network)
    page = Page("methods.md", options.output)
    with threads(1):
        in_short(page, described, options.data / "camvid")
        corridor = open_dataset(options.data / "vprbench" / "corridor", "vpr-bench")
        parts = [corridor.select(role=role) for role in ("query", "reference")]
        trial = _trials.trial_of(described, CORRIDOR, IMAGES, parts)
        outcomes = _trials.try_all(
            described, [trial], [_trials.Rival(name, name) for name in RIVALS]
        )
        page.table(f"## {trial.title}\n", table(outcomes))
    page.section("## What could not be run", _trials.without(outcomes))


def in_short(page: Page, described: Described, camvid: Path) -> None:
    """The table with a row for every method; minimum and maximum beside the page."""
    [search] = _trials.camvid_trials(described, camvid)[0].searches
    frames = list(described.drive(search.queries).seen(search.query_rows[:PICTURES]))
    references = len(search.reference_rows)
    measured = _trials.costs(described, RIVALS, frames, references, (ROUNDS, ROUNDS_OF_NETWORKS))
    found = rates(page.output.with_name("results.csv"))
    size = "{} x {} pixels".format(*frames[0].labels.shape)
    about = COSTS.format(processor=processor(), size=size, references=references)
    page.paragraph("Costs on", paragraph(about))
    names = "sees", "bytes a place", "encode, ms", "match, ms", "single frames", "steps"
    lines = [*head_row("method", *names)]
    for name, cost in measured.items():
        times = (significant(median(values)) for values in (cost.encode, cost.match))
        quality = (found.get((name, way), "-") for way in ("single frames", "with the steps"))
        sees = "images" if name in OF_PICTURES else "label maps"
        size = f"{cost.bytes_a_reference:.0f}"
        lines.append(row(_trials.shown(name, cost), sees, size, *times, *quality))
    page.table("Costs on", lines)
    with page.output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        sheet = csv.writer(file)
        sheet.writerow(("method", "what", "median ms", "least", "most"))
        for name, cost in measured.items():
            for what, values in (("encode", cost.encode), ("match", cost.match)):
                numbers = (median(values), min(values), max(values))
                sheet.writerow((name, what, *(significant(number) for number in numbers)))


def rates(results: Path) -> dict[tuple[str, str], str]:
    """Mean RecallRate@1 over the conditions of `TRAVERSES`, by method and way."""
    found: dict[tuple[str, str], list[float]] = {}
    with results.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["data set"] in TRAVERSES:
                rate = float(line["RecallRate@1"])
                found.setdefault((line["method"], line["way"]), []).append(rate)
    return {key: f"{mean(values):.3f}" for key, values in found.items()}


def table(outcomes: _trials.Outcomes) -> Iterator[str]:
    """The table of one condition."""
    yield from head_row("method", *FIGURES)
    yield from (row(name, *figures(outcome)) for (_, name), outcome in outcomes.items())


def figures(outcome: _trials.Outcome) -> list[str]:
    """Cells of `FIGURES`, or the reason why a method could not be run."""
    if isinstance(outcome, str):
        return [_trials.reason(outcome)] * len(FIGURES)
    return [interval(value, ends) for value, *ends in outcome.figures().values()]


if __name__ == "__main__":
    main()
