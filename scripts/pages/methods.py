#!/usr/bin/env python3
"""Writes docs/methods.md: input, cost and accuracy of every method.

    .venv/bin/python scripts/pages/methods.py --camvid ../shared/data/camvid \
        --corridor ../shared/data/vprbench/corridor --network ../shared/data/networks/espnetv2.yaml

Neither data set is part of this project. For CamVid see `_trials.py`. `corridor` has the layout
of VPR-Bench: `query` and `ref`, and the ground truth and stored results in the folder or beside it
(see `stored_in`). The accuracy on real traverses is read from docs/results.csv, see `results.py`.
Descriptors are cached in `--cache`, so an interrupted run can be resumed.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from statistics import mean, median

import numpy as np
from _costs import ENCODED
from _decide import FIGURES, Decisions
from _described import OF_PICTURES, Condition, Described
from _markdown import Page, head_row, interval, paragraph, processor, row, significant
from _trials import (
    IMAGES,
    Outcome,
    Outcomes,
    Rival,
    camvid_trials,
    costs,
    named,
    reason,
    shown,
    trial_of,
    try_all,
    without,
)

from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.datasets.layouts import open_dataset

CORRIDOR = "Corridor"
PICTURES = 8
ROUNDS, ROUNDS_OF_NETWORKS = 40, 8
RIVALS = (
    *("SSR-VLAD, paper", "SSR-VLAD, default", "label grid", "HOG", "CoHOG"),
    *("NetVLAD", "Region-VLAD", "LoST-X", "features", "tiny image"),
)
TECHNIQUES = {"CoHOG": "CoHOG", "Region-VLAD": "RegionVLAD", "NetVLAD": "NetVLAD"}
"""VPR-Bench's names of techniques in file names, by our names."""

TOP = 10
TRAVERSES = ("UofA", "Gardens Point")

COSTS = f"""Costs on {{processor}}, at {{size}}: the median of {ROUNDS} frames
({ROUNDS_OF_NETWORKS} for networks with random weights); the methods take turns, and one that runs
again and again, with warm caches, takes less. [methods.csv](methods.csv) has minimum and maximum.
There are {{references}} references, for LoST-X and tiny image {ENCODED}."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--corridor", type=Path, help="folder of VPR-Bench's corridor")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--network", type=Path, help="YAML file, for features and LoST-X")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/described"))
    arguments.add_argument("--output", type=Path, default=Path("docs/methods.md"))
    options = arguments.parse_args()
    described = Described(None, options.cache, {}, options.weights, options.network)
    page, outcomes = Page("methods.md", options.output), {}
    with threads(1):
        if options.camvid:
            in_short(page, described, options)
        if options.corridor:
            corridor = open_dataset(options.corridor, "vpr-bench")
            parts = [corridor.select(role=role) for role in ("query", "reference")]
            problem = trial_of(described, CORRIDOR, IMAGES, parts)
            outcomes = try_all(described, [problem], [Rival(name, name) for name in RIVALS])
            page.table(f"## {named(problem)}\n", table(outcomes))
            theirs = stored(options.corridor, problem, outcomes)
            page.table(f"## {CORRIDOR}: what VPR-Bench stored\n", theirs)
    page.section("## What could not be run", missing(options, outcomes))


def in_short(page: Page, described: Described, options: argparse.Namespace) -> None:
    """The table with a row for every method; minimum and maximum beside the page."""
    [search] = camvid_trials(described, options.camvid)[0].searches
    frames = list(described.drive(search.queries).seen(search.query_rows[:PICTURES]))
    references = len(search.reference_rows)
    measured = costs(described, RIVALS, frames, references, (ROUNDS, ROUNDS_OF_NETWORKS))
    found = rates(options.output.parent / "results.csv")
    size = "{} x {} pixels".format(*frames[0].labels.shape)
    about = COSTS.format(processor=processor(), size=size, references=references)
    page.paragraph("Costs on", paragraph(about))
    names = "sees", "bytes a place", "encode, ms", "match, ms", "single frames", "steps"
    lines = [*head_row("method", *names)]
    for name, cost in measured.items():
        times = (significant(median(values)) for values in (cost.encode, cost.match))
        quality = (found.get((name, way), "-") for way in ("single frames", "with the steps"))
        sees = "images" if name in OF_PICTURES else "label maps"
        lines.append(
            row(shown(name, cost), sees, f"{cost.bytes_a_reference:.0f}", *times, *quality)
        )
    page.table("Costs on", lines)
    with options.output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        sheet = csv.writer(file)
        sheet.writerow(("method", "what", "median ms", "least", "most"))
        for name, cost in measured.items():
            for what, values in (("encode", cost.encode), ("match", cost.match)):
                numbers = (median(values), min(values), max(values))
                sheet.writerow((name, what, *(significant(number) for number in numbers)))


def rates(results: Path) -> dict[tuple[str, str], str]:
    """Mean RecallRate@1 over the conditions of `TRAVERSES`, by method and way."""
    found: dict[tuple[str, str], list[float]] = {}
    with results.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["data set"] in TRAVERSES:
                rate = float(line["RecallRate@1"])
                found.setdefault((line["method"], line["way"]), []).append(rate)
    return {key: f"{mean(values):.3f}" for key, values in found.items()}


def table(outcomes: Outcomes) -> Iterator[str]:
    """The table of one condition."""
    yield from head_row("method", *FIGURES)
    yield from (row(name, *figures(outcome)) for (_, name), outcome in outcomes.items())


def stored(corridor: Path, problem: Condition, outcomes: Outcomes) -> Iterator[str]:
    """The results that VPR-Bench stored beside the corridor, and how often our methods agree."""
    yield from head_row("technique", *FIGURES, "same best match as ours")
    for name, theirs in TECHNIQUES.items():
        file = corridor.parent / f"{corridor.name}_{theirs}.npz"
        if not file.exists():
            continue
        found, ours = stored_in(file), outcomes[named(problem), name]
        same = reason(ours) if isinstance(ours, str) else f"{same_best(ours, found):.1%}"
        yield row(name, *figures(found), same)


def same_best(ours: Decisions, stored: Decisions) -> float:
    return float((ours.rows[:, 0] == stored.rows[:, 0]).mean())


def stored_in(file: Path) -> Decisions:
    """Results of VPR-Bench: ``sim (Q, R)``, and the true matches of query ``i`` as
    ``gt_flat[gt_off[i] : gt_off[i + 1]]``."""
    with np.load(file, allow_pickle=False) as stored:
        similarity, flat, offsets = (stored[name] for name in ("sim", "gt_flat", "gt_off"))
    ranked = np.argsort(-similarity, axis=1, kind="stable")[:, :TOP]
    scores = np.take_along_axis(similarity, ranked, axis=1).astype(np.float32)
    return Decisions(scores, ranked, [flat[begin:end] for begin, end in pairwise(offsets)])


def figures(outcome: Outcome) -> list[str]:
    """Cells of `FIGURES`, or the reason why a method could not be run."""
    if isinstance(outcome, str):
        return [reason(outcome)] * len(FIGURES)
    return [interval(value, ends) for value, *ends in outcome.figures().values()]


def missing(options: argparse.Namespace, outcomes: Outcomes) -> Iterator[str]:
    """Methods and data sets that could not be run, and what they need."""
    if options.camvid is None:
        yield "- CamVid: no --camvid; mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid."
    if options.corridor is None:
        yield f"- {CORRIDOR}: no --corridor; github.com/MubarizZaffar/VPR-Bench."
    yield from without(outcomes)


if __name__ == "__main__":
    main()
