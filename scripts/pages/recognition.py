#!/usr/bin/env python3
"""Writes docs/recognition.md: what standardising, sweeping and following are worth, and how sure.

    .venv/bin/python scripts/pages/recognition.py --data ../shared/data

The data sets are those of `_described.py`; descriptions are kept in `--cache`. The page takes ten
minutes on one thread once they are made. How the motion was chosen is read from docs/motion.csv,
see `choose_motion.py`. With ``--fit`` it prints the coefficients for `recognition.confidence`
instead: fitted to the real traverses, to CamVid and to cities that are not measured.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from _described import NETWORKS, OF_PICTURES, Described, all_conditions, decide
from _markdown import head_row, interval, paragraph, row, write
from conditions import CITY_SEEDS, METRES, RESAMPLES
from torch import Tensor

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
OURS = "SSR-VLAD, default"
METHODS = (OURS, "label grid", "HOG")
LEARNED_ON = (10, 11)
BINS = 10

HEAD = f"""# How to get the most out of it

Written by `scripts/pages/recognition.py`; no number here is typed by hand. RecallRate@1, in
brackets 95 % bootstrap intervals over the queries ({RESAMPLES} resamples). Each column adds a step
to the one before; the baselines, a label grid and HOG of the picture, get the same steps, but the
sweep, which they do not have.

- *Standardise*: each traverse's own mean is taken off its descriptors (Schubert et al., ICRA 2020).
  It costs nothing. A stream takes the mean so far.
- *Sweep*: a query is described from several anchors and a reference scores its best; how wide the
  sweep is, is chosen for each traverse from its scores. It costs a search for each anchor.
- *Follow*: a hidden Markov model over the rows of the map, whose state is place and speed. It costs
  about a quarter of the search for each query. Queries that are no sequence are noticed and judged
  one by one. *Online* a query is judged by those before it; with a delay also by so many after it
  (`--follow online --delay {DELAY}`), which is worth waiting for where single frames are poor.

City: {len(CITY_SEEDS)} cities, a true match is within {METRES:g} m. CamVid: odd against even
frames; all frames of a stop are one place. The real traverses (UofA, Gardens Point) are the outputs
of two networks that were trained elsewhere; their frames correspond one to one, at nearly equal
speeds, which favours any sequence filter.
"""

CHOICE = """Three settings of `Motion` are chosen by `scripts/pages/choose_motion.py`: `weight`,
`level` and `change`. Each data set is shown with the setting that is best on the *other* three, and
with the one that is best on all, which the package has. Where the two rows agree, the data set did
not choose its own setting. Drives *cut up* have a stop, a stretch at double speed, two jumps and a
stretch back: smooth drives alone would choose a filter that does not follow these. *Half of the
map* is the area under precision over recall where half of the places are not in the map."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--data", type=Path, help="folder of camvid, uofa and gardens_walk")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/described"))
    arguments.add_argument("--fit", action="store_true", help="print coefficients of confidence")
    arguments.add_argument("--output", type=Path, default=Path("docs/recognition.md"))
    options = arguments.parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    if options.fit:
        fit(described)
        return
    write(options.output, "\n".join(page(described, options.output.parent / "motion.csv")) + "\n")


def page(described: Described, motion: Path) -> Iterator[str]:
    yield HEAD
    told: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in STEPS}
    for method in METHODS:
        yield f"## {method}\n"
        yield from head_row("condition", *STEPS)
        for condition in all_conditions(described):
            if method in OF_PICTURES and not condition.has_pictures:
                continue
            cells = []
            for step, steps in STEPS.items():
                found = decide(described, condition, method, steps)
                value, *ends = found.figures()["RecallRate@1"]
                cells.append(interval(value, ends))
                if method == OURS and condition.dataset == "City":
                    told[step].append((found.confidence, found.right))
            yield row(condition.name, *cells)
        yield ""
    if motion.exists():
        yield "## How the filter was chosen\n"
        yield paragraph(CHOICE)
        yield from table(motion)
        yield ""
    yield "## How sure\n"
    yield paragraph(
        "The confidence of each first candidate against how often it is right, in the cities "
        f"above, none of which it was fitted to; {BINS} bins of equal width, and the expected "
        "calibration error over them."
    )
    ends = [f"{n / BINS:g} to {(n + 1) / BINS:g}" for n in range(BINS)]
    yield from head_row("steps", "error", *ends)
    for step, pairs in told.items():
        if step not in ("single frames", "standardised"):
            sure, hits = (np.concatenate(column) for column in zip(*pairs, strict=True))
            yield row(step, *reliability(sure, hits))


def table(file: Path) -> Iterator[str]:
    """The lines of a CSV file."""
    with file.open(encoding="utf-8") as lines:
        names, *rows = csv.reader(lines)
    yield from head_row(*names)
    yield from (row(*cells) for cells in rows)


def reliability(sure: np.ndarray, hits: np.ndarray) -> list[str]:
    """The calibration error, and how often the queries of each bin are right."""
    bins = np.minimum((sure * BINS).astype(int), BINS - 1)
    error, cells = 0.0, []
    for number in range(BINS):
        inside = bins == number
        cells.append(f"{hits[inside].mean():.2f} of {inside.sum()}" if inside.any() else "")
        if inside.any():
            error += inside.mean() * abs(sure[inside].mean() - hits[inside].mean())
    return [f"{error:.3f}", *cells]


def fit(described: Described) -> None:
    """Prints offset and slope of the confidence over that of the module, for each way."""
    for step in ("and swept", "online", "offline"):
        conditions: Sequence = list(all_conditions(described, LEARNED_ON, NETWORKS))
        found = [decide(described, condition, OURS, STEPS[step]) for condition in conditions]
        sure = torch.from_numpy(np.concatenate([one.confidence for one in found])).double()
        truth = torch.from_numpy(np.concatenate([one.right for one in found])).double()
        offset, slope = logistic(torch.logit(sure, 1e-4), truth)
        print(f"{step}: offset {offset:.2f} and slope {slope:.2f} over the present logit")


def logistic(told: Tensor, truth: Tensor) -> list[float]:
    """Offset and slope of the logistic regression of what is true on what is told."""
    weights = torch.tensor([0.0, 1.0], dtype=torch.double, requires_grad=True)
    search = torch.optim.LBFGS([weights], max_iter=200)

    def loss() -> Tensor:
        search.zero_grad()
        value = F.binary_cross_entropy_with_logits(weights[0] + weights[1] * told, truth)
        value.backward()
        return value

    search.step(loss)
    return weights.tolist()


if __name__ == "__main__":
    main()
