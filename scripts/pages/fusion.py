#!/usr/bin/env python3
"""Writes docs/fusion.md: label maps, features and pictures together.

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
from _markdown import DOCS, ROOT, Page, first_table, head_row, parser, quote, row

from ssrvlad_torch.recognition.recognise import Steps

MEMBERS = (OURS, FEATURES, "HOG")
SUMMED = (*MEMBERS, *reversed(FUSED))
WAYS = {
    "Picture by picture": ALONE,
    "Standardised": Steps(follow=None),
    "Followed online": Steps(follow="online"),
}


def main() -> None:
    options = parser(__doc__, "fusion.md", "described").parse_args()
    torch.set_num_threads(1)
    described, page = Described(options.data, options.cache), Page("fusion.md", options.output)
    for title, steps in WAYS.items():
        page.table(f"## {title}\n", table(described, steps))
    if options.output.resolve().parent == DOCS:
        quote(ROOT / "README.md", "fusion", excerpt(page.text))


def table(described: Described, steps: Steps) -> Iterator[str]:
    """A row for each condition, and their means; *against the best* of the members."""
    available = (*real_conditions(described), *camvid_conditions(described))
    conditions = [condition for condition in available if condition.suits(FEATURES)]
    yield from head_row("condition", *SUMMED, "against the best")
    decided = (
        (decide(described, condition, m, steps).right.mean() for m in SUMMED)
        for condition in conditions
    )
    rates = np.array([list(line) for line in decided])
    ahead = rates[:, -1] - rates[:, : len(MEMBERS)].max(axis=1)
    names = [*(f"{condition.dataset}, {condition.name}" for condition in conditions), "mean"]
    figures = np.column_stack([rates, ahead])
    for name, (*rates_alone, best) in zip(names, [*figures, figures.mean(axis=0)], strict=True):
        yield row(name, *(f"{figure:.3f}" for figure in rates_alone), f"{best:+.3f}")


def excerpt(page: str) -> str:
    """The means of single pictures, for README.md."""
    names, *_, means = first_table(page, "## Picture by picture")
    means_by = dict(zip(names, means, strict=True))
    return (
        f"`default` alone {means_by[OURS]}, HOG {means_by['HOG']},\n  features "
        f"{means_by[FEATURES]}, all three {means_by[TOGETHER]}"
    )


if __name__ == "__main__":
    main()
