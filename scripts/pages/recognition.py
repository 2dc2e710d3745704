#!/usr/bin/env python3
"""Writes docs/recognition.md: the gain of standardising, sweeping and following.

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
from _described import FEATURES, OURS, TOGETHER, Condition, Described, all_conditions
from _markdown import Page, head_row, interval, parser, row

from ssrvlad_torch.recognition.recognise import AS_PAPER, Steps, recognise

DELAY = 10
STEPS = {
    "single frames": AS_PAPER,
    "standardised": Steps(sweep=False, follow=None),
    "and swept": Steps(follow=None),
    "online": Steps(follow="online"),
    f"online, {DELAY} late": Steps(follow="online", delay=DELAY),
    "offline": Steps(),
}
LENGTHS = (10, 30)
DRAWS = 10
DATASETS = ("UofA", "Gardens Point", "CamVid")
WAYS = ("frames at random", "consecutive frames")
METHODS = (OURS, FEATURES, "HOG", TOGETHER, "label grid")


def main() -> None:
    options = parser(__doc__, "recognition.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    page = Page("recognition.md", options.output)
    for method in METHODS:
        page.table(f"## {method}\n", table(described, method))
    page.table("## Queries that are no sequence\n", no_sequence(described))


def table(described: Described, method: str) -> Iterator[str]:
    """RecallRate@1 of each condition, with intervals, for each of `STEPS`."""
    yield from head_row("condition", *STEPS)
    for condition in all_conditions(described):
        if condition.suits(method):
            found = [decide(described, condition, method, steps) for steps in STEPS.values()]
            rates = (each.figures()["RecallRate@1"] for each in found)
            yield row(condition.name, *(interval(value, ends) for value, *ends in rates))


def no_sequence(described: Described) -> Iterator[str]:
    """The table, of conditions with label maps of one network."""
    yield from head_row("method", "data set", "queries", "followed", "`--follow no`", "default")
    conditions = [c for c in all_conditions(described, seeds=()) if c.dataset in DATASETS]
    for method, dataset in product((OURS, TOGETHER), DATASETS):
        suited = [c for c in conditions if c.dataset == dataset and c.suits(method)]
        for way, length in product(WAYS if suited else (), LENGTHS):
            results = [_draw(described, c, method, way, length) for c in suited]
            followed, *rates = np.concatenate(results).T
            cells = (interval(rate.mean(), _ends(rate)) for rate in rates)
            yield row(method, dataset, f"{length} {way}", f"{followed.mean():.2f}", *cells)


def _draw(
    described: Described, condition: Condition, method: str, way: str, length: int
) -> np.ndarray:
    """``(DRAWS, 3)``: whether each was followed, RecallRate@1 of single frames and default."""
    [search] = condition.searches
    names, random = described.sequences(search)[1], np.random.default_rng(length)
    members, queries = described.members(search, method, names), len(search.truth)
    results = []
    for _ in range(DRAWS):
        if way == WAYS[0]:
            rows = random.choice(queries, length, replace=False)
        else:
            rows = random.integers(queries - length) + np.arange(length)
        drawn = {
            name: member._replace(queries=member.queries[rows]) for name, member in members.items()
        }
        alone, default = (
            recognise(drawn, ["drawn"] * length, names, steps, 1)
            for steps in (Steps(follow=None), Steps())
        )
        truth = [search.truth[row] for row in rows]
        rates = [
            np.mean([best in true for best, true in zip(first, truth, strict=True)])
            for first in (each.matches.indices[:, 0].numpy() for each in (alone, default))
        ]
        results.append((default.courses["drawn"] is not None, *rates))
    return np.array(results, float)


def _ends(rates: np.ndarray) -> np.ndarray:
    """The ends of the 95 % bootstrap interval of the mean."""
    drawn = np.random.default_rng(0).choice(rates, (1000, len(rates))).mean(1)
    return np.quantile(drawn, [0.025, 0.975])


if __name__ == "__main__":
    main()
