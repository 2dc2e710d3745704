#!/usr/bin/env python3
"""Writes docs/recognition.md: the gain of standardising, sweeping and following.

    .venv/bin/python scripts/pages/recognition.py --data ../shared/data

The data sets are those of `_described.py`; descriptors are cached in `--cache`. With them, the page
takes ten minutes on one thread.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from _decide import decide
from _described import FEATURES, OURS, TOGETHER, Described, all_conditions
from _markdown import Page, head_row, interval, parser, row

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
    options = parser(__doc__, "recognition.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    page = Page("recognition.md", options.output)
    for method in METHODS:
        page.table(f"## {method}\n", table(described, method))


def table(described: Described, method: str) -> Iterator[str]:
    """RecallRate@1 of each condition, with intervals, for each of `STEPS`."""
    yield from head_row("condition", *STEPS)
    for condition in all_conditions(described):
        if condition.suits(method):
            decisions = [decide(described, condition, method, steps) for steps in STEPS.values()]
            rates = (decision.figures()["RecallRate@1"] for decision in decisions)
            yield row(condition.name, *(interval(value, ends) for value, *ends in rates))


if __name__ == "__main__":
    main()
