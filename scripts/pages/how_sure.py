#!/usr/bin/env python3
"""Writes docs/how-sure.md: estimates of wrong answers and confidence, beside the truth.

    .venv/bin/python scripts/pages/how_sure.py --data ../shared/data

The folder holds `camvid`, `uofa`, `gardens_walk` and `networks`. Descriptors and outcomes are
cached in `--cache`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from _described import Described
from _markdown import Page, head_row, interval, parser, row, save
from _sure_cases import METHODS, Case, cases
from matplotlib.figure import Figure

from ssrvlad_torch.evaluation.bootstrap import bootstrap
from ssrvlad_torch.recognition.confidence import accept, answered, estimate
from ssrvlad_torch.recognition.follow import NEAR
from ssrvlad_torch.recognition.recognise import Steps, recognise

CHOSEN = ("uofa", "0001TP", "city 0")
STEPS = {
    "one picture": Steps(follow=None),
    "alone": Steps(follow=None),
    "online": Steps(follow="online"),
    "offline": Steps(),
}
LEVELS = {"all": None, "5 %": 0.05, "20 %": 0.2}
GROUPS = ("real", "half map", "foreign", "city")
BINS, RESAMPLES = 10, 2000


class Outcome(NamedTuple):
    """What was found in a condition: confidences, and whether each answer is right in two senses;
    for each of `LEVELS` the estimate. Whether it beats the decoys."""

    group: str
    name: str
    method: str
    sure: np.ndarray
    strict: np.ndarray
    place: np.ndarray
    estimates: dict[str, tuple[float, ...]]
    beats: np.ndarray

    @property
    def chosen(self) -> bool:
        return any(part in self.name for part in CHOSEN)


def main() -> None:
    options = parser(__doc__, "how-sure.md", "how-sure").parse_args()
    torch.set_num_threads(1)
    described = Described(options.data, options.cache, shorter_side=None)
    every = list(cases(described))
    outcomes: Outcomes = {name: [] for name in STEPS}
    for name, method in product(STEPS, METHODS):
        some = [each for each in every if each.method == method]
        outcomes[name] += described.kept(
            f"outcomes {name} {method}",
            lambda some=some, name=name: [outcome(described, case, name) for case in some],
        )
    draw(outcomes, options.output.parent / "figures" / "how-sure.png")
    together = {steps: found for steps, found in outcomes.items() if steps != "one picture"}
    page = Page("how-sure.md", options.output)
    page.table("## Is the fraction of wrong answers inside the interval?\n", covered(together))
    names = ("queries", "accepted", "wrong place", "strict")
    page.table("## What `--max-wrong 0.05` accepts\n", by_method(together, names, accepted))
    page.table("## Is confidence calibrated?\n", calibrated(outcomes))
    page.table("On the real pairs by method:\n", calibrated_by_method(outcomes))


Outcomes = dict[str, list[Outcome]]
"""By steps."""


def by_method(
    outcomes: Outcomes, names: Sequence[str], figures: Callable[[list[Outcome]], Iterable]
) -> Iterator[str]:
    """A row for each of the steps, group and method."""
    yield from head_row("steps", "group", "method", *names)
    for steps, group, method in product(outcomes, GROUPS, METHODS):
        some = [each for each in outcomes[steps] if (each.group, each.method) == (group, method)]
        if some:
            yield row(steps, group, method, *map(str, figures(some)))


def covered(outcomes: Outcomes) -> Iterator[str]:
    """How often the truth is inside the interval; the last rows are sums."""
    yield from by_method(outcomes, ("accepted in", "place", "strict", "width"), coverage)
    every = [each for found in outcomes.values() for each in found]
    for label, kind in (("all", None), ("fitted to", True), ("other", False)):
        some = [each for each in every if kind in (None, each.chosen)]
        yield row(label, "", "", *coverage(some))


def calibrated(outcomes: Outcomes) -> Iterator[str]:
    ends = [f"{n / BINS:g} to {(n + 1) / BINS:g}" for n in range(BINS)]
    yield from head_row("steps", "real", "fitted to", "other", *GROUPS[1:], *ends)
    for steps, found in outcomes.items():
        real = [each for each in found if each.group == "real"]
        parts = [real, [e for e in real if e.chosen], [e for e in real if not e.chosen]]
        parts += [[e for e in found if e.group == group] for group in GROUPS[1:]]
        yield row(steps, *(calibration(part)[0] for part in parts), *calibration(real)[1])


def calibrated_by_method(outcomes: Outcomes) -> Iterator[str]:
    yield from head_row("steps", *METHODS)
    for steps, found in outcomes.items():
        real = [[e for e in found if (e.group, e.method) == ("real", m)] for m in METHODS]
        yield row(steps, *(calibration(part)[0] for part in real))


def coverage(some: Iterable[Outcome]) -> Iterator[str]:
    """In how many cases answers were accepted, how often the truth was inside, and the width."""
    tried = hits = strict = 0
    widths: list[float] = []
    for each in some:
        for least, count, _, low, high in each.estimates.values():
            tried += 1
            if not count:
                continue
            inside = each.beats & (each.sure >= least)
            hits += low <= 1 - each.place[inside].mean() <= high
            strict += low <= 1 - each.strict[inside].mean() <= high
            widths.append(high - low)
    yield f"{len(widths)} of {tried}"
    fractions = (hits / len(widths), strict / len(widths), np.median(widths)) if widths else ()
    yield from (f"{each:.2f}" for each in fractions)
    yield from [""] * (3 - len(fractions))


def accepted(some: Iterable[Outcome]) -> tuple[int, int, int, int]:
    """Queries, accepted ones, and those whose place or frame is wrong."""
    counts = np.zeros(4, int)
    for each in some:
        inside = each.beats & (each.sure >= each.estimates["5 %"][0])
        wrong = (~each.place[inside]).sum(), (~each.strict[inside]).sum()
        counts += (len(each.sure), inside.sum(), *wrong)
    return tuple(counts.tolist())


def calibration(some: Sequence[Outcome]) -> tuple[str, list[str]]:
    """The expected calibration error, and how often the answers of each bin are right."""
    sums = np.zeros((len(some), 3, BINS))
    for number, each in enumerate(some):
        bins = np.minimum((each.sure * BINS).astype(int), BINS - 1)
        for kind, values in enumerate((np.ones(len(bins)), each.sure, each.strict)):
            sums[number, kind] = np.bincount(bins, values, BINS)

    def error(drawn: np.ndarray) -> dict[str, np.ndarray]:
        count, sure, right = np.einsum("rn,nkb->krb", drawn, sums)
        return {"error": abs(sure - right).sum(1) / count.sum(1)}

    [value] = error(np.ones((1, len(some))))["error"]
    ends = bootstrap(error, len(some), RESAMPLES)["error"]
    count, _, right = sums.sum(0)
    cells = [f"{r / n:.2f} of {n:.0f}" if n else "" for n, r in zip(count, right, strict=True)]
    return interval(value, ends), cells


def draw(outcomes: Outcomes, file: Path) -> None:
    """Reliability of confidence on real pairs, and the estimate at 20 % beside the truth."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for steps, found in outcomes.items():
        real = [each for each in found if each.group == "real"]
        sure, hits = (np.concatenate([getattr(e, k) for e in real]) for k in ("sure", "strict"))
        bins = np.minimum((sure * BINS).astype(int), BINS - 1)
        full = [n for n in range(BINS) if (bins == n).sum() >= 20]
        points = [(sure[bins == n].mean(), hits[bins == n].mean()) for n in full]
        left.plot(*zip(*points, strict=True), "o-", label=steps)
    for ax in (left, right):
        ax.plot([0, 1], [0, 1], color="gray", linewidth=0.8)
    left.set(xlabel="confidence", ylabel="fraction right", title="real pairs, ten bins")
    left.legend()
    colours = {"real": "C0", "half map": "C1", "foreign": "C3", "city": "C2"}
    for each in outcomes["alone"]:
        least, count, wrong, low, high = each.estimates["20 %"]
        if count:
            inside = each.beats & (each.sure >= least)
            truth = 1 - each.place[inside].mean()
            right.plot([low, high], [truth, truth], color=colours[each.group], linewidth=0.5)
            right.plot(wrong, truth, ".", color=colours[each.group])
    right.set(xlabel="estimated wrong, with interval", ylabel="truly another place")
    right.set_title("judged alone, --max-wrong 0.2")
    for group, colour in colours.items():
        right.plot([], [], ".", color=colour, label=group)
    right.legend(loc="lower right")
    save(figure, file)


def outcome(described: Described, case: Case, steps: str) -> Outcome:
    """Recognises the queries of a case; a sequence of one query is one picture."""
    sequences = [f"{number * (steps == 'one picture')}" for number in range(len(case.search.truth))]
    known = ["map"] * len(described.rows(case.search)[1])
    members = described.members(case.search, METHODS[case.method], known)
    found = recognise(members, sequences, known, STEPS[steps], 1)
    rows = found.matches.indices[:, 0].numpy()
    away = np.array(
        [
            min(abs(true - row), default=np.inf)
            for row, true in zip(rows, case.search.truth, strict=True)
        ]
    )
    estimates = {
        name: tuple(accept(found.sure, level) if level else estimate(found.sure))
        for name, level in LEVELS.items()
    }
    right, beats = (away == 0, away <= NEAR), answered(found.sure).numpy()
    return Outcome(*case[:3], found.confidence.numpy(), *right, estimates, beats)


if __name__ == "__main__":
    main()
