#!/usr/bin/env python3
"""Writes docs/methods.md: input, cost and accuracy of every method.

    .venv/bin/python scripts/pages/methods.py --camvid ../shared/data/camvid \
        --corridor ../shared/data/vprbench/corridor

Neither data set is part of this project. For CamVid see `_problems.py`. `corridor` has the layout
of VPR-Bench: `query` and `ref`, and the ground truth and stored results in the folder or beside it
(see `_stored.py`). The accuracy on real traverses is read from docs/results.csv, see `results.py`.
Results are cached in `--cache`, so an interrupted run can be resumed.
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
from _trials import (
    TRAINED,
    Cache,
    Outcome,
    Outcomes,
    Rival,
    Trial,
    try_all,
    with_costs,
    with_network,
)

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

Written by `scripts/pages/methods.py`. The input, the cost and the accuracy of each method. HOG,
label grid and tiny image are trivial baselines.

- *Single frames* and *steps* are RecallRate@1 on real traverses: the mean over the conditions of
  UofA and Gardens Point, without and with the [steps](recognition.md) that `query` takes.
  [Results](results.md) has the other data sets and intervals.
- *Match* is one query against all references, without ranking.
- The cost of a segmentation network is not included, except in LoST-X, which runs its own.
"""

STORED = """The authors of VPR-Bench publish these results with the data set. Here they go through
the same metrics: a check of our CoHOG, and the accuracy of Region-VLAD with its published
weights, which are not available here."""

COSTS = f"""Costs on {{processor}}, at {{size}}: the median of {ROUNDS} frames
({ROUNDS_OF_NETWORKS} for networks with random weights); the methods take turns.
[methods.csv](methods.csv) has minimum and maximum. There are {{references}} references, for
LoST-X and tiny image {ENCODED}."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--corridor", type=Path, help="folder of VPR-Bench's corridor")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--network", type=Path, help="YAML file of a network, for LoST-X")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/trials"))
    arguments.add_argument("--output", type=Path, default=Path("docs/methods.md"))
    options = arguments.parse_args()
    kept = Cache(options.cache)
    camvid = camvid_problems(options.camvid) if options.camvid else []
    drives = [problem for problem in camvid if "espnetv2" not in problem.name]
    problems = [corridor_problem(options.corridor)] if options.corridor else []
    with threads(1):
        rivals = with_network(RIVALS, options.network)
        outcomes = try_all(problems, rivals, kept, options.weights)
        page = [HEAD, *(in_short(drives, with_costs(rivals), kept, options) if drives else ())]
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
    problems: Sequence[Problem], rivals: Sequence[Rival], kept: Cache, options: argparse.Namespace
) -> Iterator[str]:
    """The table with a row for every method."""
    costs = measured(problems, rivals, kept, options.weights)
    found = rates(options.output.parent / "results.csv")
    first = problems[0].searches[0]
    size = "{} x {} pixels".format(*_size(first.queries))
    references = len(first.references.places[0])
    yield paragraph(COSTS.format(processor=processor(), size=size, references=references))
    yield from head_row(
        "method", "sees", "bytes a place", "encode, ms", "match, ms", "single frames", "steps"
    )
    for rival in rivals:
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
    """The table of one condition."""
    yield f"## {problem.name}\n"
    yield from head_row("method", *COLUMNS)
    for rival in RIVALS:
        if rival.sees == problem.gives:
            yield row(rival.name, *figures(outcomes[problem.name, rival.name]))
    yield ""


def stored_section(corridor: Path, problem: Problem, outcomes: Outcomes) -> Iterator[str]:
    """The results that VPR-Bench stored for the corridor, and how often our methods agree."""
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
    """Cells of `COLUMNS`, or the reason why a method could not be run."""
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


def measured(
    problems: Sequence[Problem], rivals: Sequence[Rival], kept: Cache, weights: Path | None
) -> dict[str, Cost]:
    """Costs of the methods on frames of a data set that has label maps and images."""
    first = {problem.gives: problem.searches[0] for problem in reversed(problems)}
    drives = {kind: search.queries for kind, search in first.items()}
    references = len(next(iter(first.values())).references.places[0])
    stamps = [*(drive.stamp for drive in drives.values()), *(r.stamp(weights) for r in rivals)]
    found = kept.get(
        ("costs", references, *stamps), partial(measure_all, rivals, drives, references, weights)
    )
    return {rival.name: Cost(**found[rival.name]) for rival in rivals}


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
    """Methods and data sets that could not be run, and what they need."""
    yield "## What could not be run\n"
    if options.camvid is None:
        yield "- CamVid: no --camvid; mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid."
    if options.corridor is None:
        yield f"- {CORRIDOR}: no --corridor; github.com/MubarizZaffar/VPR-Bench."
    reasons = {rival: text for (_, rival), text in outcomes.items() if isinstance(text, str)}
    yield from (f"- {rival}: {text}." for rival, text in reasons.items())
    yield ""


if __name__ == "__main__":
    main()
