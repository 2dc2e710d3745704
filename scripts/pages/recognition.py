#!/usr/bin/env python3
"""Writes docs/evaluation/steps.csv: the gain of standardising, sweeping and sequence matching.

    .venv/bin/python scripts/pages/recognition.py --data ../shared/data

The data sets are those of `_described.py`; descriptors are cached in `--cache`. With them, the page
takes ten minutes on one thread.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
import torch
from _decide import decide
from _described import FEATURES, OURS, TOGETHER, Described, all_conditions
from _markdown import Page, head_row, interval, parser, read_csv, row, write_csv
from conditions import ROUTES

from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps

DELAY = 10
STEPS = {
    "single frames": AS_PAPER,
    "standardised": Steps(sweep=False, follow=None),
    "and swept": Steps(follow=None),
    "online": Steps(follow="online"),
    f"online, {DELAY} late": Steps(follow="online", delay=DELAY),
    "offline": Steps(),
}
METHODS = (OURS, FEATURES, "HOG", TOGETHER, "label grid")


def main() -> None:
    options = parser(__doc__, "evaluation/results.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    write_csv(options.output.parent / "steps.csv", table(Described(options.data, options.cache)))
    rows = read_csv(options.output.parent / "steps.csv")
    Page("evaluation/results.md", options.output).show("steps", ["", *means(rows), ""])


def table(described: Described) -> Iterator[str]:
    """RecallRate@1 of each method and condition, with intervals, for each of `STEPS`."""
    yield from head_row("method", "condition", *STEPS)
    for method, condition in product(METHODS, all_conditions(described)):
        if condition.suits(method):
            decisions = [decide(described, condition, method, steps) for steps in STEPS.values()]
            rates = (decision.figures()["RecallRate@1"] for decision in decisions)
            yield row(method, condition.name, *(interval(value, ends) for value, *ends in rates))


def means(rows: list[dict[str, str]]) -> Iterator[str]:
    """The mean over the pairs of UofA and Gardens Point, for each method."""
    yield from head_row("method", *STEPS)
    for method in METHODS:
        of_method = [
            row
            for row in rows
            if row["method"] == method and row["condition"].partition(",")[0] in ROUTES
        ]
        rates = (np.mean([float(row[step].split()[0]) for row in of_method]) for step in STEPS)
        yield row(method, *(f"{rate:.3f}" for rate in rates))


if __name__ == "__main__":
    main()
