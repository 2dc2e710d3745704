#!/usr/bin/env python3
"""Writes docs/evaluation/fusion.csv: label maps, features and pictures together.

    .venv/bin/python scripts/pages/fusion.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk` and `networks`; descriptors are cached in
`--cache`, see `_described.py`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from _decide import decide
from _described import (
    ALONE,
    FEATURES,
    FUSED,
    OURS,
    TOGETHER,
    Described,
    camvid_conditions,
    real_conditions,
)
from _markdown import DOCS, ROOT, Page, head_row, parser, quote, read_csv, row, write_csv

from ssrvlad_torch.recognition.recognise import Steps

MEMBERS = (OURS, FEATURES, "HOG")
SUMMED = (*MEMBERS, *reversed(FUSED))
WAYS = {
    "single frames": ALONE,
    "standardised": Steps(follow=None),
    "sequence matching, online": Steps(follow="online"),
}


def main() -> None:
    options = parser(__doc__, "evaluation/results.md", "described").parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    page = Page("evaluation/results.md", options.output)
    lines = list(table(described))
    write_csv(options.output.parent / "fusion.csv", lines)
    means = [line for line in lines[2:] if "| mean |" in line]
    page.show("fusion", ["", *lines[:2], *means, ""])
    if options.output.resolve().parent == DOCS / "evaluation":
        quote(ROOT / "README.md", "fusion", excerpt())


def table(described: Described) -> Iterator[str]:
    """A row for each way and condition, and their means; *against the best* of the members."""
    available = (*real_conditions(described), *camvid_conditions(described))
    conditions = [condition for condition in available if condition.suits(FEATURES)]
    yield from head_row("queries", "condition", *SUMMED, "against the best")
    for way, steps in WAYS.items():
        decided = (
            (decide(described, condition, m, steps).right.mean() for m in SUMMED)
            for condition in conditions
        )
        rates = np.array([list(line) for line in decided])
        ahead = rates[:, -1] - rates[:, : len(MEMBERS)].max(axis=1)
        names = [*(f"{condition.dataset}, {condition.name}" for condition in conditions), "mean"]
        figures = np.column_stack([rates, ahead])
        for name, (*members, best) in zip(names, [*figures, figures.mean(axis=0)], strict=True):
            yield row(way, name, *(f"{figure:.3f}" for figure in members), f"{best:+.3f}")


def excerpt() -> str:
    """The means of single pictures, for README.md."""
    rows = read_csv(DOCS / "evaluation" / "fusion.csv")
    means = next(row for row in rows if row["condition"] == "mean")
    return (
        f"label maps {means[OURS]}, HOG\n{means['HOG']}, features {means[FEATURES]}, "
        f"all three {means[TOGETHER]}"
    )


if __name__ == "__main__":
    main()
