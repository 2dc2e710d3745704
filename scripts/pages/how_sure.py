#!/usr/bin/env python3
"""Writes the tables of docs/evaluation/confidence.md: estimates and confidence beside the truth.

    .venv/bin/python scripts/pages/how_sure.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk`, `cmu_schenley`, `nordland` and `networks`.
Descriptors and outcomes are cached in `--cache`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import Described
from _markdown import DOCS, Page, head_row, parser, read_csv, row, save, write_csv
from _sure_cases import FRESH, Case, cases, city_cases
from matplotlib.figure import Figure

from ssrvlad_torch.recognition.recognise import Steps, recognise_by_scores
from ssrvlad_torch.recognition.sequences import SAME_PLACE_ROWS
from ssrvlad_torch.search.answers import Estimate, accept, estimate

STEPS = {"alone": Steps(follow=None), "online": Steps(follow="online"), "offline": Steps()}
LEVEL, MUCH = 0.05, 0.1
"""What is asked for of the accepted answers, and what is too much in truth."""
LOST = 0.03
BINS = 10
SHOWN = ("drive", "half of the map", "holes of 15 rows", "foreign", "all")
SHOWN_COLUMNS = ("row", "steps", "inside, all", "inside, 5 %", "above 10 %", "accepted", "wrong")
"""What the page shows of the table."""

COLUMNS = ("row", "steps", "cases", "lost", "inside, all", "inside, 5 %", "above 10 %")
COLUMNS += ("accepted", "wrong", "said", "ECE")


class Outcome(NamedTuple):
    """What was found in a case: confidence in each answer, whether it is right, and whether it
    shows at least the place; the estimates of all answers, and of those accepted at `LEVEL`."""

    row: str
    name: str
    method: str
    sure: np.ndarray
    strict: np.ndarray
    place: np.ndarray
    every: Estimate
    accepted: Estimate

    def inside(self, found: Estimate) -> bool:
        """Whether the interval of an estimate holds."""
        wrong = self.wrong(found) / found.accepted
        return found.low - 1e-6 <= wrong <= found.high + 1e-6

    def wrong(self, found: Estimate) -> int:
        """How many of the answers of an estimate show another place."""
        return int((~self.place[self.sure >= found.confidence]).sum())

    @property
    def oracle(self) -> int:
        """The most answers of which at most `LEVEL` are wrong."""
        return min(len(self.place), int(self.place.sum() / (1 - LEVEL)))


Outcomes = dict[str, list[Outcome]]
"""By steps, in the order of the cases."""


def main() -> None:
    options = parser(__doc__, "evaluation/confidence.md", "how-sure").parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache)
    every = cases(described)
    rows = {
        name: [case for case in every if case.row == name]
        for name in dict.fromkeys(case.row for case in every)
    }
    outcomes: Outcomes = {name: [] for name in STEPS}
    for name, some in rows.items():
        found = described.kept(
            f"outcomes {name}", lambda some=some: [outcome(described, case) for case in some]
        )
        for steps, each in zip(STEPS, zip(*found, strict=True), strict=True):
            outcomes[steps] += each
    draw(outcomes, DOCS / "figures" / "confidence.png")
    page = Page("evaluation/confidence.md", options.output)
    file = options.output.parent / "confidence.csv"
    write_csv(file, table(outcomes, list(rows)))
    page.show("confidence", ["", *shown(read_csv(file)), ""])
    page.table("confidence-cities", fresh(described))
    page.table("confidence-methods", by_method(outcomes))
    page.table("calibration", calibrated(outcomes))


def shown(rows: Sequence[dict[str, str]]) -> Iterator[str]:
    """The rows and columns of the table that the page shows."""
    yield from head_row(*SHOWN_COLUMNS)
    for line in rows:
        if line["row"] in SHOWN:
            yield row(*(line[name] for name in SHOWN_COLUMNS))


def outcome(described: Described, case: Case) -> list[Outcome]:
    """Recognises the queries of a case with each of the steps."""
    scores, found = case.scores(described), []
    for steps in STEPS.values():
        one = recognise_by_scores(scores, ["q"] * len(scores), case.sequences, steps, 1)
        rows = one.matches.indices[:, 0].numpy()
        away = np.array(
            [
                min(abs(true - case.rows[row]), default=np.inf) if row >= 0 else np.inf
                for row, true in zip(rows, case.truth, strict=True)
            ]
        )
        estimates = estimate(one.sure), accept(one.sure, LEVEL)
        sure = one.confidence.numpy()
        found.append(Outcome(*case[:3], sure, away == 0, away <= SAME_PLACE_ROWS, *estimates))
    return found


def table(outcomes: Outcomes, rows: Sequence[str]) -> Iterator[str]:
    """A line for each row and each of the steps; the last ones are of all."""
    yield from head_row(*COLUMNS)
    for name in (*rows, ""):
        for steps, found in outcomes.items():
            some = [number for number, each in enumerate(found) if name in ("", each.row)]
            alone = [outcomes["alone"][number] for number in some]
            yield row(name or "all", steps, *figures([found[n] for n in some], alone))


def fresh(described: Described) -> Iterator[str]:
    """A line for each of the steps, of all cases of the cities `FRESH`."""
    found = described.kept(
        "outcomes fresh",
        lambda: [outcome(described, case) for case in city_cases(described, FRESH)],
    )
    alone, *_ = zip(*found, strict=True)
    yield from head_row("row", *COLUMNS[1:])
    for steps, some in zip(STEPS, zip(*found, strict=True), strict=True):
        yield row("all", steps, *figures(some, alone))


def by_method(outcomes: Outcomes) -> Iterator[str]:
    """The same of real drives, whole and halved, by method and network."""
    yield from head_row("method and network", *COLUMNS[1:])
    kinds = ("drive", "half of a drive")
    groups = dict.fromkeys(kind_of(each) for each in outcomes["alone"] if each.row in kinds)
    for group in groups:
        for steps, found in outcomes.items():
            some = [
                n for n, each in enumerate(found) if each.row in kinds and kind_of(each) == group
            ]
            alone = [outcomes["alone"][n] for n in some]
            yield row(group, steps, *figures([found[n] for n in some], alone))


def kind_of(each: Outcome) -> str:
    """The method, and the network unless there is none or several."""
    network = each.name.rpartition(", ")[2]
    return each.method if each.method == "HOG" or " " in network else f"{each.method}, {network}"


def figures(some: Sequence[Outcome], alone: Sequence[Outcome]) -> Iterator[str]:
    """The cells of a line, see docs/evaluation/confidence.md."""
    yield str(len(some))
    yield str(
        sum(
            each.strict.mean() < other.strict.mean() - LOST
            for each, other in zip(some, alone, strict=True)
        )
    )
    said = [each for each in some if each.every.accepted and each.every.low is not None]
    taken = [each for each in some if each.accepted.accepted]
    yield fraction(each.inside(each.every) for each in said)
    yield fraction(each.inside(each.accepted) for each in taken)
    too_much = [each.wrong(each.accepted) > MUCH * each.accepted.accepted for each in taken]
    yield f"{sum(too_much)} of {len(some)}"
    could = sum(each.oracle for each in some)
    count = sum(each.accepted.accepted for each in taken)
    yield f"{count} of {could}"
    yield str(sum(each.wrong(each.accepted) for each in taken))
    yield fraction(each.every.low is not None for each in some if each.every.accepted)
    yield f"{calibration(some)[0]:.3f}"


def fraction(each: Iterable[bool]) -> str:
    """How many are true, and of how many."""
    found = list(each)
    return f"{sum(found)} of {len(found)}" if found else ""


def calibrated(outcomes: Outcomes) -> Iterator[str]:
    """How often the answers to real drives, whole and halved, of each confidence are right."""
    ends = [f"{n / BINS:g} to {(n + 1) / BINS:g}" for n in range(BINS)]
    yield from head_row("steps", "ECE", *ends)
    for steps, found in outcomes.items():
        value, cells = calibration([e for e in found if e.row in ("drive", "half of a drive")])
        yield row(steps, f"{value:.3f}", *cells)


def calibration(some: Sequence[Outcome]) -> tuple[float, list[str]]:
    """The expected calibration error, and how often the answers of each bin are right."""
    sure, right = (np.concatenate([getattr(e, k) for e in some]) for k in ("sure", "place"))
    bins = np.minimum((sure * BINS).astype(int), BINS - 1)
    count, sums, hits = (np.bincount(bins, values, BINS) for values in (None, sure, right))
    cells = [f"{r / n:.2f} of {n:.0f}" if n else "" for n, r in zip(count, hits, strict=True)]
    return float(abs(sums - hits).sum() / len(sure)), cells


def draw(outcomes: Outcomes, file: Path) -> None:
    """Reliability on real drives, and the estimate of all answers beside the truth."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, (steps, found) in enumerate(outcomes.items()):
        real = [each for each in found if each.row in ("drive", "half of a drive")]
        sure, hits = (np.concatenate([getattr(e, k) for e in real]) for k in ("sure", "place"))
        bins = np.minimum((sure * BINS).astype(int), BINS - 1)
        full = [n for n in range(BINS) if (bins == n).sum() >= 20]
        points = [(sure[bins == n].mean(), hits[bins == n].mean()) for n in full]
        left.plot(*zip(*points, strict=True), "o-", label=steps)
        for each in found:
            if each.every.accepted and each.every.low is not None:
                truth = 1 - each.place.mean()
                right.plot(each.every.wrong, truth, ".", color=f"C{number}", markersize=3)
        right.plot([], [], ".", color=f"C{number}", label=steps)
    for ax in (left, right):
        ax.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
        ax.legend()
    left.set(xlabel="confidence", ylabel="fraction right", title="real drives, ten bins")
    right.set(xlabel="estimated wrong", ylabel="truly another place", title="all answers of a case")
    save(figure, file)


if __name__ == "__main__":
    main()
