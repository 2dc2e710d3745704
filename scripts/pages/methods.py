#!/usr/bin/env python3
"""Writes docs/methods.md: every method of the harness, what it needs, costs and finds.

    .venv/bin/python scripts/pages/methods.py --camvid ../shared/data/camvid \
        --corridor ../shared/data/vprbench/corridor

Neither data set is part of this project: for CamVid see `_problems.py`, `corridor` is laid out by
VPR-Bench (`query`, `ref`, and its ground truth in the folder or beside it, where its stored results
are looked for too, see `_stored.py`). What the methods find on real traverses stands in
docs/results.csv, see `results.py`. Results are kept in `--cache`, and an interrupted run goes on
where it was.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import mean, median

from _costs import ENCODED, Cost, measure
from _markdown import head_row, interval, paragraph, processor, row, significant, write
from _problems import IMAGES, LABELS, Drive, Problem, camvid_problems, image_problem
from _stored import stored_trials
from _trials import TRAINED, Cache, Outcome, Outcomes, Rival, Trial, try_all

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.datasets.layouts import open_dataset

CORRIDOR = "Corridor"
PICTURES = 8
ROUNDS, ROUNDS_OF_NETWORKS = 40, 8
COLUMNS = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")

RIVALS = (
    *(Rival.ssrvlad(f"SSR-VLAD, {preset}", preset, 0) for preset in ("paper", "default")),
    Rival("label grid", "label-grid", LABELS),
    Rival("HOG", "hog", IMAGES),
    Rival("CoHOG", "cohog", IMAGES),
    Rival("NetVLAD", "netvlad", IMAGES),
    Rival("Region-VLAD", "region-vlad", IMAGES),
    Rival("LoST-X", "lost-x", IMAGES),
    Rival("tiny image", "tiny-image", IMAGES),
)
TRAVERSES = ("UofA", "Gardens Point")

HEAD = """# Methods

Written by `scripts/pages/methods.py`; no number is typed by hand. What each method sees, what a
place costs, and what it finds on real traverses through change: RecallRate@1, the mean over the
conditions of UofA and Gardens Point in [results.csv](results.csv), of single frames and with the
steps that `query` takes. [Results](results.md) has the other data sets, and intervals. HOG, label
grid and tiny image are the trivial methods that must be beaten.
"""

STORED = """The results that its authors publish with the data set, through the same metrics: a
check of CoHOG, and what Region-VLAD reaches with its published weights, which are not here."""

COSTS = f"""Costs on {{processor}}, at {{size}}: the median of {ROUNDS} frames ({ROUNDS_OF_NETWORKS}
for the networks with random weights) on which all methods take turns; [methods.csv](methods.csv)
has the least and the most. Matching is one query against {{references}} references, without ranking
them; LoST-X and tiny image are matched with {ENCODED} only. What a segmentation network costs is
not in it."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--corridor", type=Path, help="folder of VPR-Bench's corridor")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/trials"))
    arguments.add_argument("--output", type=Path, default=Path("docs/methods.md"))
    options = arguments.parse_args()
    kept = Cache(options.cache)
    camvid = camvid_problems(options.camvid) if options.camvid else []
    drives = [problem for problem in camvid if "espnetv2" not in problem.name]
    problems = [corridor_problem(options.corridor)] if options.corridor else []
    with threads(1):
        outcomes = try_all(problems, RIVALS, kept, options.weights)
        page = [HEAD, *(in_short(drives, kept, options) if drives else ())]
        for problem in problems:
            page += [*section(problem, outcomes)]
            page += [*stored_section(options.corridor, problem, outcomes)]
        page += missing(options, outcomes)
    write(options.output, "\n".join(page) + "\n")


def corridor_problem(folder: Path) -> Problem:
    corridor = open_dataset(folder, "vpr-bench")
    parts = (corridor.select(role=role) for role in ("query", "reference"))
    return image_problem(CORRIDOR, *parts)


def in_short(
    problems: Sequence[Problem], kept: Cache, options: argparse.Namespace
) -> Iterator[str]:
    """A line for every method."""
    costs = measured(problems, kept, options.weights)
    found = rates(options.output.parent / "results.csv")
    first = problems[0].searches[0]
    size = "{} x {} pixels".format(*_size(first.queries))
    references = len(first.references.places[0])
    told = COSTS.format(processor=processor(), size=size, references=references)
    yield paragraph(told)
    yield from head_row(
        "method", "sees", "bytes a place", "encode, ms", "match, ms", "single frames", "steps"
    )
    for rival in RIVALS:
        cost = costs[rival.name]
        name = f"{rival.name} (random weights)" if "random" in cost.method else rival.name
        times = (significant(median(values)) for values in (cost.encode, cost.match))
        quality = (found.get((rival.name, way), "-") for way in ("single frames", "with the steps"))
        sees = "label maps" if rival.sees == LABELS else "images"
        yield row(name, sees, f"{cost.bytes_a_reference:.0f}", *times, *quality)
    yield ""
    with options.output.with_suffix(".csv").open("w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(("method", "what", "median ms", "least", "most"))
        for name, cost in costs.items():
            for what, values in (("encode", cost.encode), ("match", cost.match)):
                numbers = (median(values), min(values), max(values))
                lines.writerow((name, what, *(significant(number) for number in numbers)))


def rates(results: Path) -> dict[tuple[str, str], str]:
    """Mean RecallRate@1 over the conditions of `TRAVERSES`, by method and way."""
    found: dict[tuple[str, str], list[float]] = {}
    with results.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            if line["data set"] in TRAVERSES:
                rate = float(line["RecallRate@1"])
                found.setdefault((line["method"], line["way"]), []).append(rate)
    return {key: f"{mean(values):.3f}" for key, values in found.items()}


def section(problem: Problem, outcomes: Outcomes) -> Iterator[str]:
    """All figures under one condition."""
    yield f"## {problem.name}\n"
    yield from head_row("method", *COLUMNS)
    for rival in RIVALS:
        if rival.sees == problem.gives:
            yield row(rival.name, *figures(outcomes[problem.name, rival.name]))
    yield ""


def stored_section(corridor: Path, problem: Problem, outcomes: Outcomes) -> Iterator[str]:
    """What VPR-Bench stored for the corridor, and how far our methods do the same."""
    yield f"## {CORRIDOR}: what VPR-Bench stored\n"
    yield paragraph(STORED)
    yield from head_row("technique", *COLUMNS, "same best match as ours")
    for name, stored in stored_trials(corridor).items():
        ours = outcomes.get((problem.name, name), "")
        same = reason(ours) if isinstance(ours, str) else ""
        if isinstance(ours, Trial):
            same = f"{(ours.indices[:, 0] == stored.indices[:, 0]).mean():.1%}"
        yield row(name, *figures(stored), same)
    yield ""


def figures(outcome: Outcome) -> list[str]:
    """`COLUMNS`, or why there are none."""
    if isinstance(outcome, str):
        return [reason(outcome)] * len(COLUMNS)
    found = outcome.figures("exact")
    ends = found["intervals"]
    names = ("auc_pr", "recall_at_100_precision")
    return [
        *(interval(found["recall_at"][n], ends["recall_at"][n]) for n in ("1", "5")),
        *(interval(found[name], ends[name]) for name in names),
    ]


def reason(outcome: str) -> str:
    if not outcome:
        return ""
    return "weights not here" if outcome.startswith("no weights") else "not run"


def measured(problems: Sequence[Problem], kept: Cache, weights: Path | None) -> dict[str, Cost]:
    """What the methods cost on frames of a data set that has label maps and images."""
    first = {problem.gives: problem.searches[0] for problem in reversed(problems)}
    drives = {kind: search.queries for kind, search in first.items()}
    references = len(next(iter(first.values())).references.places[0])
    stamps = [*(drive.stamp for drive in drives.values()), *(r.stamp(weights) for r in RIVALS)]
    found = kept.get(
        ("costs", references, *stamps), partial(measure_all, RIVALS, drives, references, weights)
    )
    return {rival.name: Cost(**found[rival.name]) for rival in RIVALS}


def measure_all(
    rivals: Sequence[Rival], drives: dict[str, Drive], references: int, weights: Path | None
) -> dict[str, dict]:
    frames = {kind: list(islice(drive, PICTURES)) for kind, drive in drives.items()}
    measured = measure(
        {rival.name: partial(rival.make, weights, True) for rival in rivals},
        {rival.name: frames[rival.sees] for rival in rivals},
        references,
        {r.name: ROUNDS_OF_NETWORKS if r.method in TRAINED else ROUNDS for r in rivals},
    )
    return {name: asdict(cost) for name, cost in measured.items()}


def _size(drive: Drive) -> tuple[int, int]:
    frame: Frame = next(iter(drive))
    return (frame.image if frame.labels is None else frame.labels).shape[:2]


def missing(options: argparse.Namespace, outcomes: Outcomes) -> Iterator[str]:
    """What could not be run, and how to get what it needs."""
    yield "## What could not be run\n"
    if options.camvid is None:
        yield "- CamVid: no --camvid; mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid."
    if options.corridor is None:
        yield f"- {CORRIDOR}: no --corridor; github.com/MubarizZaffar/VPR-Bench."
    reasons = {rival: told for (_, rival), told in outcomes.items() if isinstance(told, str)}
    yield from (f"- {rival}: {told}." for rival, told in reasons.items())
    yield ""


if __name__ == "__main__":
    main()
