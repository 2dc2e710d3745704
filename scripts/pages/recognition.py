#!/usr/bin/env python3
"""Writes docs/evaluation/steps.csv, the gain of standardising, sweeping and sequence matching, and
the table of docs/guides/live.md.

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
from _markdown import DOCS, Page, head_row, interval, parser, read_csv, row, write_csv
from conditions import ROUTES, Search

from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps, recognise
from ssrvlad_torch.recognition.sequences import MIN_FRAMES

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
LIVE = {
    "evening in a map of the day": "evening -> day, espnetv2",
    "right side in a map of the left": "right -> left, espnetv2",
    "night in a map of the day": "night -> right, espnetv2",
}
SURE = 0.9


def main() -> None:
    options = parser(__doc__, "evaluation/results.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    guide = DOCS / "guides" / "live.md"
    Page("guides/live.md", guide).show("live", ["", *live(described), ""])
    write_csv(options.output.parent / "steps.csv", table(described))
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


def live(described: Described) -> Iterator[str]:
    """How good the tracker is by label maps and HOG, and in brackets by label maps alone."""
    steps = ("frame by frame", "tracker", f"delay {DELAY}", f"first {MIN_FRAMES} frames")
    yield from head_row("", *steps, f"above {SURE}: how many, wrong")
    searches = {c.name: c.searches[0] for c in all_conditions(described)}
    for title, name in LIVE.items():
        cells = (tracked(described, searches[name], m) for m in ("without features", OURS))
        yield row(title, *(f"{both} ({alone})" for both, alone in zip(*cells, strict=True)))


def tracked(described: Described, search: Search, method: str) -> list[str]:
    """A row of the table by one method: RecallRate@1, and of the tracker how many answers are
    sure and how many of these are wrong."""
    queries, references = described.sequences(search)
    descriptors, town = described.members(search, method, references)
    recognised, right = {}, {}
    for name in ("and swept", "online", f"online, {DELAY} late"):
        recognised[name] = recognise(descriptors, queries, town, STEPS[name], 1)
        rows = recognised[name].matches.indices[:, 0].tolist()
        pairs = zip(rows, search.truth, strict=True)
        right[name] = np.array([answer in truth for answer, truth in pairs])
    sure = (recognised["online"].confidence > SURE).numpy()
    rates = [*(each.mean() for each in right.values()), right["online"][:MIN_FRAMES].mean()]
    wrong = (sure & ~right["online"]).sum()
    return [*(f"{rate:.2f}" for rate in rates), f"{sure.mean():.2f}, {wrong}"]


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
