"""Table I of the paper and its PR curves: all methods on whichever data sets are there."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import _paper
from _curves import draw
from _described import IMAGES, LABELS, UNPROCESSED, Condition, Described, city_conditions
from _markdown import Page, head_row, interval, row
from _trials import (
    CAMVID,
    Outcome,
    Outcomes,
    Rival,
    camvid_trials,
    reason,
    trial_of,
    try_all,
    without,
)
from conditions import CITY_SEEDS

from ssrvlad_torch.datasets.layouts import open_dataset
from ssrvlad_torch.evaluation.metrics import Convention
from ssrvlad_torch.segmentation.segmenter import Segmenter

CONVENTION: Convention = "vpr-bench"
REACH = 3
CITY_CONDITIONS = ("clean", "all together")
NOT_HERE = "not here"
FIGURE = "paper_pr_curves.png"

CITY = "Synthetic city"
OURS = "SSR-VLAD, default"
NETWORKS = (_paper.COHOG, _paper.NETVLAD, _paper.REGION_VLAD, _paper.LOST_X)

RIVALS = (
    *(Rival(name, name) for name in NETWORKS),
    Rival(_paper.SSR_VLAD, _paper.SSR_VLAD, REACH),
    Rival(_paper.UNPROCESSED, UNPROCESSED, REACH),
    Rival(f"{_paper.SSR_VLAD}, t = 0", _paper.SSR_VLAD),
    Rival(OURS, OURS, REACH),
    Rival(f"{OURS}, t = 0", OURS),
    *(Rival(name, name) for name in ("label grid", "HOG", "tiny image")),
)

DRAWN = tuple(rival.name for rival in RIVALS if not rival.name.endswith("t = 0"))


class PaperSet(NamedTuple):
    """A data set of the paper: the searched sequences, and where to get it."""

    name: str
    folder: str
    layout: str
    queries: str
    references: str
    labels_as: str
    origin: str


_VPR_BENCH = "github.com/MubarizZaffar/VPR-Bench"
PAPER_SETS = (
    PaperSet(
        _paper.CMU,
        *("slice7", "extended-cmu", "slice7-c0-2010-10-01", "slice7-c0-2011-11-21"),
        "cityscapes-trainids",
        "visuallocalization.net/datasets, Extended CMU Seasons; label maps by a segmenter",
    ),
    PaperSet(
        _paper.ROBOTCAR,
        *("CrossSeason_CoHOG_Dataset", "vpr-bench", "query", "ref"),
        "cityscapes-trainids",
        f"{_VPR_BENCH}; label maps by a segmenter",
    ),
    PaperSet(
        _paper.SYNTHIA,
        *("Synthia-NightToFall", "vpr-bench", "query", "ref"),
        "synthia",
        f"{_VPR_BENCH}; label maps at synthia-dataset.net",
    ),
)

Lacking = dict[tuple[str, str], str]
"""The reason why a data set has no label maps or no images, by its name and the kind."""


def part(page: Page, options: argparse.Namespace, described: Described) -> None:
    """Table I, and the figure beside the page."""
    problems, lacking = open_all(options, described)
    print("Not here:", *missing(lacking, {}), sep="\n", flush=True)
    outcomes = try_all(described, problems, RIVALS)
    draw(problems, outcomes, DRAWN, CONVENTION, options.output.parent / "figures" / FIGURE)
    page.table("## Table I: recognition\n", in_short(problems, outcomes))
    for dataset in (*(chosen.name for chosen in PAPER_SETS), CAMVID, CITY):
        page.table(f"### {dataset}\n", table(dataset, problems, outcomes))
    page.section("### What could not be run", missing(lacking, outcomes))


def open_all(options: argparse.Namespace, described: Described) -> tuple[list[Condition], Lacking]:
    """The conditions that can be searched, and what is missing."""
    problems: list[Condition] = []
    lacking: Lacking = {(CITY, IMAGES): "it is made of label maps"}
    for chosen in PAPER_SETS:
        for kind in (LABELS, IMAGES):
            try:
                problems.append(open_one(chosen, kind, options, described))
            except ValueError as error:
                lacking[chosen.name, kind] = f"{error}; {chosen.origin}"
    if options.camvid:
        problems += camvid_trials(described, options.camvid)
    else:
        why = "no --camvid; mi.eng.cam.ac.uk/research/projects/VideoRec/CamVid"
        lacking |= dict.fromkeys([(CAMVID, LABELS), (CAMVID, IMAGES)], why)
    cities = city_conditions(described, CITY_SEEDS, CITY_CONDITIONS)
    return problems + [each._replace(dataset=CITY) for each in cities], lacking


def open_one(
    chosen: PaperSet, kind: str, options: argparse.Namespace, described: Described
) -> Condition:
    """A data set of the paper by one kind of frames.

    Raises:
        ValueError: it is not there, or lacks this kind.
    """
    places = (folder for place in options.data for folder in (place, place / chosen.folder))
    folder = next((f for f in places if f.name == chosen.folder and f.is_dir()), None)
    if folder is None:
        raise ValueError(f"no folder {chosen.folder} in --data")
    own = folder / "labels"
    labels = own if kind == LABELS and own.is_dir() else None
    whole = open_dataset(folder, chosen.layout, labels, chosen.labels_as)
    if whole.truth and whole.truth.metres is not None:
        whole = whole.posed()
    parts = [whole.select([name]) for name in (chosen.queries, chosen.references)]
    segmenter = None
    if kind == LABELS and labels is None:
        if options.segmenter is None:
            raise ValueError(f"no label maps in {chosen.folder}/labels, and no --segmenter")
        kept = options.cache / "segmented"
        segmenter = Segmenter.load(options.segmenter, "cityscapes-trainids", kept)
    return trial_of(described, chosen.name, kind, parts, segmenter)


def in_short(problems: Sequence[Condition], outcomes: Outcomes) -> Iterator[str]:
    """The effect of pre-processing and of the temporal sum, by condition."""
    yield from head_row("condition", "preset", "as in the paper", "no pre-processing", "t = 0")
    for problem in problems:
        for preset in ("paper", "default") if problem.gives == LABELS else ():
            names = [f"SSR-VLAD, {preset}{end}" for end in ("", ", no pre-processing", ", t = 0")]
            known = [outcomes.get((problem.title, name)) for name in names]
            cells = (_cells(found)[1] if found else "" for found in known)
            yield row(problem.title, preset, *cells)


def table(dataset: str, problems: Sequence[Condition], outcomes: Outcomes) -> Iterator[str]:
    """A line for each method and condition."""
    printed = _paper.TABLE_I.get(dataset)
    here = [problem for problem in problems if problem.dataset == dataset]
    own = [name for metric in _paper.METRICS for name in (metric, *["the paper"] * bool(printed))]
    yield from head_row("method", "condition", *own)
    for rival in RIVALS:
        of_paper = printed.get(rival.name, ("",) * 3) if printed else None
        asked = [p for p in here if p.gives == rival.sees]
        for problem in asked:
            cells = _cells(outcomes[problem.title, rival.name])
            yield row(rival.name, problem.name, *_beside(cells, of_paper))
        if not asked and (here or rival.name in (printed or ())):
            why = f"no {rival.sees}" if dataset == CITY else NOT_HERE
            yield row(rival.name, "", *_beside([why] * 3, of_paper))


def _cells(outcome: Outcome) -> list[str]:
    """`_paper.METRICS` with intervals, the first two in per cent."""
    if isinstance(outcome, str):
        return [reason(outcome)] * 3
    figures = outcome.figures(CONVENTION)
    rates = (figures[name] for name in _paper.METRICS[:2])
    area, *ends = figures["AUC-PR"]
    return [*(interval(100 * a, (100 * b, 100 * c), 1) for a, b, c in rates), interval(area, ends)]


def _beside(ours: Sequence[str], of_paper: Sequence[str] | None) -> list[str]:
    if of_paper is None:
        return list(ours)
    return [cell for pair in zip(ours, of_paper, strict=True) for cell in pair]


def missing(lacking: Lacking, outcomes: Outcomes) -> Iterator[str]:
    """Data sets and methods that could not be run, and what they need."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for (dataset, kind), why in lacking.items():
        kinds.setdefault((dataset, why), []).append(kind)
    for (dataset, why), lacks in kinds.items():
        yield f"- {dataset}, {' and '.join(lacks)}: {why}."
    yield from without(outcomes)
