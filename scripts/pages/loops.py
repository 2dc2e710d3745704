#!/usr/bin/env python3
"""Writes the tables of docs/evaluation/loops.md: precision and recall of the loop detector.

    .venv/bin/python scripts/pages/loops.py --data ../shared/data

Real drives are folders of ``--data``, see `_loops_real.py`. Others follow `synthetic_city.TOUR`
through synthetic cities. Descriptors are cached. Needs the extra `dev`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _loops_real import CUT, LATER, ONE_STREAM, WAYS, real_drives
from _markdown import (
    DOCS,
    Page,
    head_row,
    interval,
    parser,
    quote,
    read_csv,
    row,
    save,
)
from _timing import threads
from _tours import Tour, Tours, all_tours, head
from matplotlib.figure import Figure

from ssrvlad_torch import LoopDetector
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.evaluation.curves import PrecisionRecall
from ssrvlad_torch.evaluation.loops import (
    LoopScore,
    loop_curve,
    loop_errors,
    score_loops,
)
from ssrvlad_torch.evaluation.thresholds import bootstrap
from ssrvlad_torch.files import write_picture
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.picture import draw_loops
from ssrvlad_torch.loops.result import LoopResult
from ssrvlad_torch.loops.stream import loops_of, rows_of_candidates

MEASURED_ON = range(6)
CHECKED_ON = range(6, 8)
METRES, ELSEWHERE = 10.0, 25.0
RESAMPLES = 2000
KINDS = {
    "lighting change or other side": ("day ->", "evening", "right", "left", "night"),
    "CamVid, odd frames after even ones": ("0001TP", "0016E5"),
}
"""Kinds of pairs by how their names begin."""


@dataclass(frozen=True)
class Outcome:
    """Results of a detector on a tour: for each frame the row of its loop and the row of its
    candidate, accepted or not; -1 without one."""

    tour: Tour
    results: list[LoopResult]
    loops: np.ndarray
    candidates: np.ndarray
    score: LoopScore

    @property
    def errors(self) -> np.ndarray:
        """Metres between each frame that closes a loop and its candidate."""
        return loop_errors(self.loops, self.tour.poses)


def main() -> None:
    options = parser(__doc__, "evaluation/loops.md", "loops").parse_args()
    with threads(1):
        measured, checked = (
            all_tours(cities, options.cache) for cities in (MEASURED_ON, CHECKED_ON)
        )
        page = Page("evaluation/loops.md", options.output)
        real_drives(page, options.data, options.cache)
        pairs = read_csv(options.output.parent / "loops-pairs.csv")
        page.show("loops-pairs", ["", *in_short(pairs), ""])
        page.table("loops-cut", cut_cities(measured))
        page.table("loops-cities", cities(measured, checked))
    if options.output.resolve().parent == DOCS / "evaluation":
        quote(DOCS / "guides" / "loops.md", "loops", excerpt())


def in_short(rows: list[dict[str, str]]) -> Iterator[str]:
    """The mean recall of each kind of pairs, and how many of their loops lead elsewhere."""
    _, *ways = rows[0]
    yield from head_row("pairs", *ways)
    for kind, begins in KINDS.items():
        of_kind = [row for row in rows if row["drives"].startswith(begins)]
        yield row(
            f"{len(of_kind)} pairs, {kind}", *(in_one([r[way] for r in of_kind]) for way in ways)
        )


def in_one(cells: Sequence[str]) -> str:
    """The mean of recalls, and the sum of loops that lead elsewhere; empty for no recalls."""
    parts = [cell.removesuffix(" elsewhere").partition(", ") for cell in cells if cell]
    if not parts:
        return ""
    elsewhere = sum(int(count or 0) for _, _, count in parts)
    mean = f"{np.mean([float(recall) for recall, _, _ in parts]):.2f}"
    return f"{mean}, {elsewhere} elsewhere" if elsewhere else mean


def cities(measured: Tours, checked: Tours) -> Iterator[str]:
    """Rows on tours through cities; draws the figures of the page."""
    figures = DOCS / "figures"
    names = ("labels", "cities", "loops", "wrong", "elsewhere", "precision", "recall")
    yield from head_row(*names, "before a wrong one")
    found: dict[str, PrecisionRecall] = {}
    for condition, tours in measured.items():
        for name, some in (("measured", tours), ("check", checked[condition])):
            outcomes = [detect(tour) for tour in some]
            curves = curve(outcomes)
            best = f"{curves.recall_at_full_precision:.3f}"
            yield row(condition, name, *scores(outcomes), best)
            if name == "measured":
                found[condition] = curves
            if (condition, name) == ("perfect labels", "measured"):
                picture = draw_loops(outcomes[0].loops, tours[0].poses, condition, METRES)
                write_picture(picture, figures / "loops-perfect.png")
    draw_curves(figures / "loops-curves.png", found)


def scores(outcomes: Sequence[Outcome]) -> list[str]:
    """Cells of a table: loops, wrong ones, those that lead elsewhere, precision and recall."""
    errors = np.concatenate([outcome.errors for outcome in outcomes])
    counts = np.array([outcome.score for outcome in outcomes], float)

    def fractions(drawn: np.ndarray) -> dict[str, np.ndarray]:
        accepted, right, revisits = (drawn @ counts).T
        with np.errstate(invalid="ignore"):
            return {"precision": right / accepted, "recall": right / revisits}

    ends = bootstrap(fractions, len(outcomes), RESAMPLES)
    score = LoopScore(*counts.sum(axis=0).astype(int).tolist())
    return [
        *map(str, (len(errors), (errors > METRES).sum(), (errors > ELSEWHERE).sum())),
        interval(score.precision, ends["precision"]),
        interval(score.recall, ends["recall"]),
    ]


def curve(outcomes: Sequence[Outcome]) -> PrecisionRecall:
    """Precision and recall over all thresholds; the probabilities do not depend on them."""
    errors = [loop_errors(outcome.candidates, outcome.tour.poses) for outcome in outcomes]
    probabilities = [r.confidence for o in outcomes for r in o.results if r.candidate is not None]
    right = np.concatenate(errors) <= METRES
    exclude = LoopConfig.exclude
    found = [score_loops(o.candidates, o.tour.poses, exclude, METRES) for o in outcomes]
    revisits = sum(score.revisits for score in found)
    return loop_curve(np.array(probabilities), right, revisits)


def detect(tour: Tour, stamps: np.ndarray | None = None) -> Outcome:
    """Runs a detector over a tour."""
    detector = LoopDetector(head=head())
    when = np.full(len(tour.poses), np.nan) if stamps is None else stamps
    results = [
        detector.observe(FrameRecord("tour", f"{number:06d}", stamp=float(stamp)), descriptor)
        for number, (descriptor, stamp) in enumerate(zip(tour.descriptors, when, strict=True))
    ]
    loops, candidates = loops_of(detector, results), rows_of_candidates(detector, results)
    score = score_loops(loops, tour.poses, LoopConfig.exclude, METRES)
    return Outcome(tour, results, loops, candidates, score)


def cut_cities(tours: Tours) -> Iterator[str]:
    """Rows on tours that go on an hour after their middle, without some frames between."""
    yield from head_row("cities", "loops", "wrong", "elsewhere", "precision", "recall")
    for condition, whole in tours.items():
        outcomes = []
        for tour in whole:
            middle = len(tour.poses) // 2
            kept = np.r_[:middle, middle + CUT : len(tour.poses)]
            stamps = np.arange(len(kept)) / 3 + LATER * (kept > middle)
            outcomes.append(
                detect(
                    replace(tour, descriptors=tour.descriptors[kept], poses=tour.poses[kept]),
                    stamps,
                )
            )
        yield row(condition, *scores(outcomes))


def draw_curves(path: Path, curves: Mapping[str, PrecisionRecall]) -> None:
    """Plots precision over recall."""
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.subplots()
    for condition, found in curves.items():
        axes.plot(found.recall, found.precision, lw=1.4, label=condition)
    axes.set(xlim=(0, 1), ylim=(0.8, 1.005), xlabel="recall", ylabel="precision")
    axes.grid(lw=0.3)
    axes.legend(loc="lower left", frameon=False)
    save(figure, path)


def excerpt() -> str:
    """Mean recalls of the pairs with a lighting change, for the guide."""
    begins = KINDS["lighting change or other side"]
    table = read_csv(DOCS / "evaluation" / "loops-pairs.csv")
    rows = [row for row in table if row["drives"].startswith(begins)]
    pictures, labels = (
        [in_one([row[f"{method}: {way}"] for row in rows]).partition(",")[0] for way in WAYS[:2]]
        for method in reversed(ONE_STREAM)
    )
    return (
        f"{pictures[0]} by features and HOG under one name without stamps, {pictures[1]} an hour "
        f"later by stamps, and {labels[0]} and {labels[1]} by label maps"
    )


if __name__ == "__main__":
    main()
