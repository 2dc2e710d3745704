#!/usr/bin/env python3
"""Writes docs/loops.md: what the checks and the settings of the loop detector are worth.

    .venv/bin/python scripts/pages/loops.py

The drives follow `synthetic_city.TOUR` through synthetic cities. Thresholds are chosen by
`evaluation.thresholds.suggested` on cities that are not measured. Needs the extra `dev`.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from _markdown import head_row, interval, paragraph, row, write
from _tours import SCALE_ERROR, TURN_ERROR, Tour, Tours, all_tours, head
from matplotlib.figure import Figure

from ssrvlad_torch import LoopConfig, LoopDetector
from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.evaluation.bootstrap import bootstrap
from ssrvlad_torch.evaluation.curves import PrecisionRecall
from ssrvlad_torch.evaluation.loops import (
    LoopScore,
    loop_curve,
    loop_errors,
    score_loops,
    surest,
)
from ssrvlad_torch.evaluation.thresholds import OperatingPoint
from ssrvlad_torch.files import replacing
from ssrvlad_torch.loops.geometry import SharedKeypoints
from ssrvlad_torch.loops.picture import draw_loops
from ssrvlad_torch.loops.result import LoopResult, Reason
from ssrvlad_torch.loops.sighting import GeometricCheck, PoseGate
from ssrvlad_torch.loops.stream import loops_of

LEARNED_ON = range(100, 106)
MEASURED_ON = range(8)
METRES, ELSEWHERE = 10.0, 25.0
LOWEST = {True: 3.0, False: 0.5}
"""Thresholds of the runs that a curve is made of, relative and not."""
GATE_METRES = 60.0
RESAMPLES = 2000


@dataclass(frozen=True)
class Variant:
    """Settings of a detector other than the defaults, and what is plugged in."""

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    pose_gate: PoseGate | None = None
    geometry: GeometricCheck | None = None

    @property
    def lowest(self) -> float:
        return LOWEST[self.settings.get("relative", 1) > 0]


@dataclass(frozen=True)
class Outcome:
    """What a detector did in a tour: its results, and the row of each frame's loop, or -1."""

    tour: Tour
    results: list[LoopResult]
    loops: np.ndarray
    score: LoopScore

    @property
    def errors(self) -> np.ndarray:
        """Metres between each frame that closes a loop and its candidate."""
        return loop_errors(self.loops, self.tour.poses)


def near_by_odometry(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The pose gate: at most `GATE_METRES` apart."""
    return np.hypot(*(there - here)[:, :2].T) <= GATE_METRES


DEFAULT = Variant("ratio test and confirmations")
CHECKS = (
    Variant("threshold alone", {"ratio": 1.0, "confirmations": 1}),
    Variant("ratio test", {"confirmations": 1}),
    Variant("confirmations", {"ratio": 1.0}),
    DEFAULT,
    Variant("both and keypoints", geometry=SharedKeypoints()),
    Variant("both and poses", pose_gate=near_by_odometry),
    Variant("all", pose_gate=near_by_odometry, geometry=SharedKeypoints()),
)
SETTINGS = (
    Variant("default"),
    Variant("exclude = 0", {"exclude": 0}),
    Variant("relative = 0 (cosine)", {"relative": 0}),
    Variant("relative = 20", {"relative": 20}),
    *(Variant(f"temporal = {t}", {"temporal": t}) for t in (0, 3)),
    *(Variant(f"ratio = {r}", {"ratio": r}) for r in (0.8, 0.95)),
    *(Variant(f"confirmations = {k}", {"confirmations": k}) for k in (2, 5)),
    *(Variant(f"window = {w}", {"window": w}) for w in (1, 6)),
    *(Variant(f"neighbourhood = {n}", {"neighbourhood": n}) for n in (5, 20)),
)

INTRODUCTION = (
    "# Loop closures\n",
    "Written by `scripts/pages/loops.py`; no number is typed by hand.\n",
    paragraph(
        "A drive is `synthetic_city.TOUR`: 3.3 km, about 1100 frames, with streets driven again in "
        "the same direction and in the opposite one, among them an estate of 400 m where every "
        f"block looks like the next. {len(MEASURED_ON)} cities are measured, each with perfect "
        "labels, and with a segmentation network's mistakes under a camera that sways. In brackets "
        f"stand 95 % bootstrap intervals over the cities ({RESAMPLES} resamples); where no loop is "
        "wrong, none is in any resample."
    ),
    paragraph(
        f"A loop is right if its two frames are within {METRES:g} m, and wrong otherwise; it is "
        f"*elsewhere* if they are more than {ELSEWHERE:g} m apart. Recall is over the frames that "
        "come back to a place looking the same way: driven the other way, a street is another "
        "picture."
    ),
    paragraph(
        f"Each threshold was chosen on {len(LEARNED_ON)} other cities under the same condition, "
        "for each detector its own: the one that `evaluation.thresholds.suggested` gives there for "
        "the highest precision that it is sure of, as `ssrvlad loops --tolerance-metres` does. "
        f"There, a detector ran once with a threshold of {LOWEST[True]:g}, and the strengths of "
        "its loops make the curve; here it really ran with the threshold that came out. The last "
        "two columns are the recall that such a curve of the measured drives reaches before its "
        "first wrong loop, and before its first loop elsewhere: what a threshold chosen for just "
        "these drives would give."
    ),
)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--output", type=Path, default=Path("docs/loops.md"))
    options = arguments.parse_args()
    with threads(1):
        page = "\n".join(sections(all_tours(LEARNED_ON), all_tours(MEASURED_ON), options.output))
    write(options.output, page + "\n")


def sections(learned: Tours, measured: Tours, page: Path) -> Iterator[str]:
    """Lines of the page; its figures are written beside it."""
    yield from INTRODUCTION
    for condition, tours in measured.items():
        yield f"## {condition.capitalize()}\n"
        name = f"loops-{condition.split()[0]}.png"
        threshold = chosen(DEFAULT, learned[condition]).score
        yield f"![](figures/{name})\n"
        yield paragraph(
            f"City {tours[0].city} with the threshold {threshold:.2f}; green loops are right."
        )
        draw(page.parent / "figures" / name, detect(DEFAULT, threshold, tours[0]), condition)
        yield from table(CHECKS, learned[condition], tours)
        yield from where_and_why(threshold, tours)
    yield paragraph(
        f"Keypoints: `SharedKeypoints()`. Poses: a gate of {GATE_METRES:g} m around an odometry "
        f"that drifts, with an error of {100 * SCALE_ERROR:g} % in scale and {TURN_ERROR:g} "
        "degrees a frame."
    )
    yield "![](figures/loops-curves.png)\n"
    draw_curves(page.parent / "figures" / "loops-curves.png", measured)
    yield "## What each setting is worth\n"
    for condition, tours in measured.items():
        yield f"{condition.capitalize()}:\n"
        yield from table(SETTINGS, learned[condition], tours)
    yield from default_threshold(learned, measured)


def table(
    variants: Sequence[Variant], learned: Sequence[Tour], measured: Sequence[Tour]
) -> Iterator[str]:
    """A line for each variant: its threshold, and what it does."""
    yield from head_row(
        *("checks", "threshold", "loops", "wrong", "elsewhere", "precision", "recall"),
        *("before a wrong one", "before one elsewhere"),
    )
    for variant in variants:
        print(variant.name, flush=True)
        threshold = chosen(variant, learned).score
        outcomes = [detect(variant, threshold, tour) for tour in measured]
        low = [detect(variant, variant.lowest, tour) for tour in measured]
        best = [curve(low, metres).recall_at_full_precision for metres in (METRES, ELSEWHERE)]
        shares = (f"{float(recall):.3f}" for recall in best)
        yield row(variant.name, f"{threshold:.2f}", *figures(outcomes), *shares)
    yield ""


def figures(outcomes: Sequence[Outcome]) -> list[str]:
    errors = np.concatenate([outcome.errors for outcome in outcomes])
    score = total(outcomes)
    ends = intervals(outcomes)
    return [
        *(str(count) for count in (len(errors), (errors > METRES).sum())),
        str((errors > ELSEWHERE).sum()),
        interval(score.precision, ends["precision"]),
        interval(score.recall, ends["recall"]),
    ]


def total(outcomes: Sequence[Outcome]) -> LoopScore:
    return LoopScore(*np.sum([outcome.score for outcome in outcomes], axis=0).tolist())


def intervals(outcomes: Sequence[Outcome]) -> dict[str, tuple[float, float]]:
    counts = np.array([outcome.score for outcome in outcomes], float)

    def shares(drawn: np.ndarray) -> dict[str, np.ndarray]:
        accepted, right, revisits, recognised = (drawn @ counts).T
        with np.errstate(invalid="ignore"):
            return {"precision": right / accepted, "recall": recognised / revisits}

    return bootstrap(shares, len(outcomes), RESAMPLES)


def where_and_why(threshold: float, tours: Sequence[Tour]) -> Iterator[str]:
    """Where the default detector finds loops, and how often it gives each reason."""
    outcomes = [detect(DEFAULT, threshold, tour) for tour in tours]
    exclude = LoopConfig.exclude
    same = [tour.comes_back(exclude, METRES) for tour in tours]
    other = [tour.comes_back(exclude, METRES, opposite=True) for tour in tours]
    kinds = {
        "come back looking the same way": same,
        "come back looking the opposite way only": [
            b & ~a for a, b in zip(same, other, strict=True)
        ],
        "at a place for the first time": [~(a | b) for a, b in zip(same, other, strict=True)],
        "in the estate": [tour.in_estate() for tour in tours],
    }
    yield paragraph(f"With {DEFAULT.name}, by where the frames are:")
    yield from head_row("frames", "number", "loops", "right", "wrong")
    for name, chosen_frames in kinds.items():
        counts = np.zeros(3, int)
        for outcome, frames in zip(outcomes, chosen_frames, strict=True):
            errors = outcome.errors[frames[outcome.loops >= 0]]
            counts += (frames.sum(), (errors <= METRES).sum(), (errors > METRES).sum())
        number, right, wrong = counts.tolist()
        yield row(name, str(number), str(right + wrong), str(right), str(wrong))
    yield ""
    counted = Counter(result.reason for outcome in outcomes for result in outcome.results)
    yield from head_row("reason", *(reason.value for reason in Reason))
    yield row("frames", *(str(counted[reason]) for reason in Reason))
    yield ""


def default_threshold(learned: Tours, measured: Tours) -> Iterator[str]:
    """What `LoopConfig()` does as it is."""
    yield "## The default threshold\n"
    most = max(chosen(DEFAULT, tours).score for tours in learned.values())
    yield paragraph(
        "A deployment should choose its own, on drives of its own with poses. "
        f"`LoopConfig.threshold` is {LoopConfig.threshold:g}: the larger of the two that were "
        f"chosen above, {most:.2f}, rounded up to a tenth, {math.ceil(10 * most) / 10:g}. With it:"
    )
    yield from head_row("labels", "loops", "wrong", "elsewhere", "precision", "recall")
    for condition, tours in measured.items():
        outcomes = [detect(DEFAULT, LoopConfig.threshold, tour) for tour in tours]
        yield row(condition, *figures(outcomes))


def chosen(variant: Variant, tours: Sequence[Tour]) -> OperatingPoint:
    point = surest(curve([detect(variant, variant.lowest, tour) for tour in tours]))
    assert point
    return point


def curve(outcomes: Sequence[Outcome], metres: float = METRES) -> PrecisionRecall:
    """Of the loops that a detector with a low threshold found."""
    strengths = np.array([r.strength for o in outcomes for r in o.results if r.accepted])
    right = np.concatenate([outcome.errors for outcome in outcomes]) <= metres
    return loop_curve(strengths, right, total(outcomes).revisits)


def detect(variant: Variant, threshold: float, tour: Tour) -> Outcome:
    """Shows a tour to a detector."""
    config = replace(LoopConfig(), threshold=threshold, **variant.settings)
    detector = LoopDetector(config, head(), variant.pose_gate, variant.geometry)
    results = [
        detector.observe(
            FrameRecord("tour", f"{number:06d}", *tour.odometry[number]),
            descriptor,
            keypoints=tour.keypoints[number],
        )
        for number, descriptor in enumerate(tour.descriptors)
    ]
    loops = loops_of(detector, results)
    # What is excluded belongs to the detector, which frames come back to the drive.
    score = score_loops(loops, tour.poses, LoopConfig.exclude, METRES)
    return Outcome(tour, results, loops, score)


def draw(path: Path, outcome: Outcome, condition: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_loops(path, outcome.loops, outcome.tour.poses, condition, METRES)


def draw_curves(path: Path, measured: Tours) -> None:
    """Precision over recall, a column for each condition."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    for axes, (condition, tours) in zip(figure.subplots(1, 2), measured.items(), strict=True):
        for variant in CHECKS:
            found = curve([detect(variant, variant.lowest, tour) for tour in tours])
            axes.plot(found.recall, found.precision, lw=1.4, label=variant.name)
        axes.set(title=condition, xlim=(0, 1), ylim=(0.8, 1.005), xlabel="recall")
        axes.grid(lw=0.3)
    figure.axes[0].set_ylabel("precision")
    figure.axes[0].legend(fontsize=8, loc="lower left", frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
