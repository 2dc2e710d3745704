#!/usr/bin/env python3
"""Writes docs/methods.md: every method of the harness, how well it recognises and what it costs.

    .venv/bin/python scripts/pages/methods.py --camvid ../shared/data/camvid \
        --corridor ../shared/data/vprbench/corridor

Neither data set is part of this project: for CamVid see `_problems.py`, `corridor` is laid out by
VPR-Bench (`query`, `ref`, and its ground truth in the folder or beside it, where its stored results
are looked for too, see `_stored.py`). Without them only the synthetic city is measured. Results are
kept in `--cache`, and an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path

from _costs import ENCODED, Cost, measure
from _markdown import head_row, interval, median_low_high, paragraph, processor, row, write
from _problems import (
    CITY,
    CITY_CONDITIONS,
    CITY_FRAMES,
    CITY_SEEDS,
    IMAGES,
    LABELS,
    Drive,
    Problem,
    camvid_problems,
    city_problems,
    image_problem,
)
from _stored import stored_trials
from _trials import RESAMPLES, TRAINED, Cache, Outcome, Outcomes, Rival, Trial, try_all

from ssrvlad_torch.baselines import Frame
from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.datasets.layouts import open_dataset

CORRIDOR = "Corridor"
PICTURES = 8
ROUNDS, ROUNDS_OF_NETWORKS = 40, 8
COLUMNS = ("RecallRate@1", "RecallRate@5", "AUC-PR", "Recall@100%Precision")

RIVALS = (
    *(
        Rival.ssrvlad(f"SSR-VLAD, {preset}, t = {reach}", preset, reach)
        for preset in ("paper", "default")
        for reach in (0, 3)
    ),
    Rival("label grid", "label-grid", LABELS),
    Rival("CoHOG", "cohog", IMAGES),
    Rival("NetVLAD", "netvlad", IMAGES),
    Rival("Region-VLAD", "region-vlad", IMAGES),
    Rival("LoST-X", "lost-x", IMAGES),
    Rival("HOG", "hog", IMAGES),
    Rival("tiny image", "tiny-image", IMAGES),
)

HEAD = f"""# Methods

Written by `scripts/pages/methods.py`; no number is typed by hand. Metrics by convention `exact`, in
brackets 95 % bootstrap intervals over the queries ({RESAMPLES} resamples). SSR-VLAD and label
grid see label maps, the others images. t is the reach of SSR-VLAD's temporal sum over the
references (Eq. 3); tiny image and LoST-X use the neighbours of a reference too. HOG, label grid and
tiny image are the trivial methods that must be beaten.

CamVid: the odd frames of two drives against the even ones; a true match is a neighbouring frame.
`espnetv2` is the output of a real network that was trained on other data. Corridor: VPR-Bench's,
images without label maps. Synthetic city: {len(CITY_SEEDS)} cities of {CITY_FRAMES} references, of
which there are no images, {CITY_FRAMES} queries a drive, another traffic and 0.7 m to the left in
every condition; a true match is within 5 m.
"""

STORED = """The results that its authors publish with the data set, through the same metrics: a
check of CoHOG, and what Region-VLAD reaches with its published weights, which are not here."""

COSTS = f"""On {{processor}}; median [min, max] of {ROUNDS} frames ({ROUNDS_OF_NETWORKS} for the
networks with random weights) on which all methods of a table take turns. Matching is one query
against all references, without ranking them; LoST-X and tiny image are matched with {ENCODED} only.
What a segmentation network costs is not in it."""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--camvid", type=Path, help="folder of CamVid")
    arguments.add_argument("--corridor", type=Path, help="folder of VPR-Bench's corridor")
    arguments.add_argument("--weights", type=Path, help="folder of the trained networks' weights")
    arguments.add_argument("--cache", type=Path, default=Path(".cache/trials"))
    arguments.add_argument("--output", type=Path, default=Path("docs/methods.md"))
    options = arguments.parse_args()
    kept, problems = Cache(options.cache), open_all(options)
    with threads(1):
        outcomes = try_all(problems, RIVALS, kept, options.weights)
        page = [
            HEAD,
            *in_short(problems, outcomes),
            *(line for problem in problems for line in section(problem, outcomes)),
            *(stored_section(options.corridor, problems, outcomes) if options.corridor else ()),
            "## Cost\n",
            paragraph(COSTS.format(processor=processor())),
            *(line for same in by_dataset(problems) for line in costs(same, kept, options.weights)),
            *missing(options, outcomes),
        ]
    write(options.output, "\n".join(page) + "\n")


def open_all(options: argparse.Namespace) -> list[Problem]:
    problems = camvid_problems(options.camvid) if options.camvid else []
    if options.corridor:
        corridor = open_dataset(options.corridor, "vpr-bench")
        parts = (corridor.select(role=role) for role in ("query", "reference"))
        problems.append(image_problem(CORRIDOR, *parts))
    return problems + city_problems(CITY_CONDITIONS)


def by_dataset(problems: Sequence[Problem]) -> list[list[Problem]]:
    names = dict.fromkeys(problem.dataset for problem in problems)
    return [[problem for problem in problems if problem.dataset == name] for name in names]


def in_short(problems: Sequence[Problem], outcomes: Outcomes) -> Iterator[str]:
    """RecallRate@1 of every method under every condition."""
    yield "## In short\n"
    yield "RecallRate@1; empty where the method cannot see what there is.\n"
    asked = [p for p in problems if any((p.name, r.name) in outcomes for r in RIVALS)]
    yield from head_row("method", *(problem.name for problem in asked))
    for rival in RIVALS:
        found = [outcomes.get((problem.name, rival.name), "") for problem in asked]
        yield row(rival.name, *(figures(outcome)[0].partition(" [")[0] for outcome in found))
    yield ""


def section(problem: Problem, outcomes: Outcomes) -> Iterator[str]:
    """All figures under one condition."""
    yield f"## {problem.name}\n"
    yield from head_row("method", *COLUMNS)
    for rival in RIVALS:
        if rival.sees == problem.gives:
            yield row(rival.name, *figures(outcomes[problem.name, rival.name]))
    yield ""


def stored_section(
    corridor: Path, problems: Sequence[Problem], outcomes: Outcomes
) -> Iterator[str]:
    """What VPR-Bench stored for the corridor, and how far our methods do the same."""
    yield f"## {CORRIDOR}: what VPR-Bench stored\n"
    yield paragraph(STORED)
    yield from head_row("technique", *COLUMNS, "same best match as ours")
    (problem,) = (problem for problem in problems if problem.dataset == CORRIDOR)
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


def costs(problems: Sequence[Problem], kept: Cache, weights: Path | None) -> Iterator[str]:
    """A table of what the methods cost on the frames of one data set."""
    first = {problem.gives: problem.searches[0] for problem in reversed(problems)}
    rivals = [rival for rival in RIVALS if rival.sees in first and not rival.name.endswith("= 3")]
    drives = {kind: search.queries for kind, search in first.items()}
    references = len(next(iter(first.values())).references.places[0])
    stamps = [*(drive.stamp for drive in drives.values()), *(r.stamp(weights) for r in rivals)]
    measured = kept.get(
        ("costs", references, *stamps), partial(measure_all, rivals, drives, references, weights)
    )
    height, width = _size(next(iter(drives.values())))
    yield f"### {problems[0].dataset}: {height} x {width} pixels, {references} references\n"
    yield from head_row("method", "bytes a reference", "encode, ms", "match, ms")
    for rival in rivals:
        cost = Cost(**measured[rival.name])
        name = f"{rival.name} (random weights)" if "random" in cost.method else rival.name
        times = map(median_low_high, (cost.encode, cost.match))
        yield row(name.replace(", t = 0", ""), f"{cost.bytes_a_reference:.0f}", *times)
    yield ""


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
    yield f"- {CITY}, images: it is made of label maps."
    if options.camvid is None:
        yield "- CamVid: no --camvid; mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid."
    if options.corridor is None:
        yield f"- {CORRIDOR}: no --corridor; github.com/MubarizZaffar/VPR-Bench."
    else:
        yield f"- {CORRIDOR}, labels: it has no label maps."
    reasons = {rival: told for (_, rival), told in outcomes.items() if isinstance(told, str)}
    yield from (f"- {rival}: {told}." for rival, told in reasons.items())
    yield ""


if __name__ == "__main__":
    main()
