#!/usr/bin/env python3
"""Writes docs/recognition.md: the gain of standardising, sweeping and following.

    .venv/bin/python scripts/pages/recognition.py --data ../shared/data

The data sets are those of `_described.py`; descriptors are cached in `--cache`. With them, the page
takes ten minutes on one thread. How the filter was chosen is kept as the page has it.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from _decide import decide
from _described import FEATURES, OURS, TOGETHER, Described, all_conditions
from _markdown import head_row, interval, kept, parser, row, write
from _no_sequence import no_sequence_section
from conditions import CITY_SEEDS, METRES, RESAMPLES

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

HEAD = f"""# How to get the most out of it

1. Give whole drives: a folder is a sequence, frames in the order of travel, at most a few metres
   apart. Under other light a drive that is followed is found where single frames are not: compare
   the first and the last column.
2. Keep the default steps. Each is taken only where the scores show that it applies, and the last
   line that a command prints says which were taken.
3. Take the network whose labels look best on *your* pictures, the same for map and queries.
4. If you have pictures, let them take part:
   [with pictures as well](guides/choosing.md#with-pictures-as-well).
5. Wait if you can: `--follow offline` for recorded drives, `--delay 10` for live ones.
6. Do not sum over time (`--temporal`) unless frames are far denser than the places that you tell
   apart.
7. A camera that is turned by up to 10 degrees or is up to 2 m aside costs little; a street driven
   the other way is [not recognised](way-back.md).

## How it was measured

Written by `scripts/pages/recognition.py`. The tables show RecallRate@1 with 95 % bootstrap
intervals over the queries ({RESAMPLES} resamples). Each column adds one step to the column before:

- *Standardise* subtracts the mean descriptor of each traverse (Schubert et al., ICRA 2020); on a
  stream, the mean so far. It costs nothing.
- *Sweep* describes a query around several image columns (anchors); a reference gets the best of
  their scores. The width of the sweep is chosen for each traverse from its scores. It costs one
  search per anchor.
- *Follow* finds the sequence with a hidden Markov model, whose state is the row of the map and the
  speed. It costs about a quarter of the search.

The columns of following differ in the queries that they use: *online* the queries so far, *online,
{DELAY} late* (`--follow online --delay {DELAY}`) also the {DELAY} queries after, *offline* all
queries. A delay helps where single frames are poor. Queries that do not form a sequence are
[judged one by one](#queries-that-are-no-sequence).

The label grid and HOG of the pictures are baselines. They get the same steps, except the sweep.

- *City*: {len(CITY_SEEDS)} synthetic cities; a true match is within {METRES:g} m.
- *CamVid*: odd frames are queries, even frames are references; all frames of a stop are one place.
- *UofA and Gardens Point* (evening, day, left, right, night): outputs of two networks trained on
  other data. The frames correspond one to one at nearly equal speeds, which makes following
  easier.
"""


def main() -> None:
    options = parser(__doc__, "recognition.md", "described", needs_data=False).parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    write(options.output, "\n".join(page(described)) + "\n")


def page(described: Described) -> Iterator[str]:
    yield HEAD
    for method in METHODS:
        yield f"## {method}\n"
        yield from head_row("condition", *STEPS)
        for condition in all_conditions(described):
            if not condition.suits(method):
                continue
            cells = []
            for steps in STEPS.values():
                found = decide(described, condition, method, steps)
                value, *ends = found.figures()["RecallRate@1"]
                cells.append(interval(value, ends))
            yield row(condition.name, *cells)
        yield ""
    yield from no_sequence_section(described)
    yield kept("recognition.md", "## How the filter was chosen")


if __name__ == "__main__":
    main()
