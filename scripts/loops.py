#!/usr/bin/env python3
"""Writes docs/loops.md: what the checks and the settings of the loop detector are worth.

    .venv/bin/python scripts/loops.py

The drives follow `synthetic_city.TOUR` through several synthetic cities. Thresholds are chosen by
`evaluation.thresholds.suggested` on cities that are not measured.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.bench import threads
from ssrvlad_torch.database import FrameRecord
from ssrvlad_torch.datasets.segmentation_noise import SegmentationNoise
from ssrvlad_torch.datasets.synthetic_city import TOUR, TOUR_ESTATES, Conditions, SyntheticCity
from ssrvlad_torch.evaluation.curves import PrecisionRecall
from ssrvlad_torch.evaluation.loops import LoopScore, score_loops
from ssrvlad_torch.evaluation.thresholds import suggested
from ssrvlad_torch.loop_closure import (
    GeometricCheck,
    KeyPoints,
    LoopDetector,
    LoopResult,
    PoseGate,
    Reason,
)
from ssrvlad_torch.loop_config import LoopConfig
from ssrvlad_torch.loop_geometry import SharedKeypoints
from ssrvlad_torch.loop_stream import loops_of

LABELS_AS = "cityscapes-trainids"
BATCH = 16
LEARNED_ON = range(100, 103)
MEASURED_ON = range(4)
METRES = 10.0
SURE_PRECISION = 0.99
CONDITIONS = {
    "perfect labels": Conditions(),
    "noisy labels": Conditions(heading_jitter=2.0, noise=SegmentationNoise(), seed=1),
}
DEVIATIONS = np.arange(8.5, 3.9, -0.5).tolist()
COSINES = np.arange(0.99, 0.74, -0.025).tolist()
GATE_METRES = 60.0
SCALE_ERROR, TURN_ERROR = 0.01, 0.05
"""Of the odometry: standard deviations of its scale, and of its error in degrees a frame."""


@dataclass(frozen=True)
class Drive:
    """A tour through a city: descriptors, key-points, true poses, and poses by odometry."""

    descriptors: Tensor
    keypoints: list[KeyPoints]
    poses: np.ndarray
    odometry: np.ndarray


Runs = dict[str, list[Drive]]
"""Drives by their condition."""


@dataclass(frozen=True)
class Variant:
    """Settings of a detector other than the defaults, and what is plugged in."""

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    pose_gate: PoseGate | None = None
    geometry: GeometricCheck | None = None

    @property
    def thresholds(self) -> list[float]:
        return DEVIATIONS if self.settings.get("relative", 1) else COSINES


def near_by_odometry(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """The pose gate: at most `GATE_METRES` apart."""
    return np.hypot(*(there - here)[:, :2].T) <= GATE_METRES


CHECKS = (
    Variant("threshold alone", {"ratio": 1.0, "confirmations": 1}),
    Variant("and ratio test", {"confirmations": 1}),
    Variant("and confirmations", {"ratio": 1.0}),
    Variant("and both: the default"),
    Variant("default and key-points", geometry=SharedKeypoints()),
    Variant("default and poses", pose_gate=near_by_odometry),
    Variant("default, key-points, poses", pose_gate=near_by_odometry, geometry=SharedKeypoints()),
)
SETTINGS = (
    Variant("default"),
    Variant("relative = 0 (cosine)", {"relative": 0}),
    Variant("relative = 20", {"relative": 20}),
    *(Variant(f"temporal = {t}", {"temporal": t}) for t in (0, 3)),
    Variant("ratio = 0.8", {"ratio": 0.8}),
    *(Variant(f"confirmations = {k}", {"confirmations": k}) for k in (2, 5)),
    *(Variant(f"window = {w}", {"window": w}) for w in (1, 6)),
    *(Variant(f"neighbourhood = {n}", {"neighbourhood": n}) for n in (5, 20)),
)

HEAD_TEXT = f"""# Loop closures

Written by `scripts/loops.py`; no number here is typed by hand. The drives are
`synthetic_city.TOUR`: 3.3 km, about 1100 frames, streets driven again in the same direction and in
the opposite one, among them an estate of 400 m where every block looks like the next.
{len(MEASURED_ON)} cities are measured, each with perfect labels and with noisy ones under a camera
that sways. A loop is right if its two frames are within {METRES:g} m; recall is over all frames
that come back to a place looking the same way. Driven the other way a street is another picture:
nothing is found there, and nothing must be.

The threshold of each detector is the one that `evaluation.thresholds.suggested` gives on
{len(LEARNED_ON)} other cities, both conditions together: the lowest at which the precision is
surely, by Wilson's 95 % interval, at least {SURE_PRECISION:g}; "not sure" where none is. "At
precision 1" is the recall that the best threshold for just these drives would give without one
wrong loop.
"""


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--output", type=Path, default=Path("docs/loops.md"))
    options = arguments.parse_args()
    with threads(1):
        learned_on = [drive for drives in all_drives(LEARNED_ON).values() for drive in drives]
        measured_on = all_drives(MEASURED_ON)
        text = [
            HEAD_TEXT,
            "## What each check is worth\n",
            *table(CHECKS, learned_on, measured_on, at_best=True),
            POSES_TEXT,
            *refusals(measured_on),
            "## What each setting is worth\n",
            *table(SETTINGS, learned_on, measured_on),
        ]
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text("\n".join(text) + "\n", encoding="utf-8")
    print(options.output)


POSES_TEXT = f"""
Key-points: `SharedKeypoints`. Poses: a gate of {GATE_METRES:g} m around an odometry that drifts,
with an error of {100 * SCALE_ERROR:g} % in scale and {TURN_ERROR:g} degrees a frame.
"""


def table(
    variants: Sequence[Variant],
    learned_on: Sequence[Drive],
    measured_on: Runs,
    at_best: bool = False,
) -> Iterator[str]:
    """A line for each variant: its threshold, and what it does in each condition; on demand also
    the recall that its best threshold would have."""
    columns = ["detector", "threshold"]
    for name in measured_on:
        columns += [f"{name}: loops", "wrong", "precision", "recall"]
        columns += ["at precision 1"] * at_best
    yield line(columns)
    yield line(["---"] * len(columns))
    for variant in variants:
        print(variant.name, flush=True)
        point = suggested(sweep(variant, learned_on), SURE_PRECISION)
        cells = [variant.name, f"{point.score:.4g}" if point else "not sure"]
        for drives in measured_on.values():
            cells += figures(variant, point.score, drives) if point else [""] * 4
            if at_best:
                cells.append(f"{float(sweep(variant, drives).recall_at_full_precision):.3f}")
        yield line(cells)
    yield ""


def refusals(measured_on: Runs) -> Iterator[str]:
    """How often each reason is given by the default detector."""
    yield "Reasons of the default detector:\n"
    yield line(["condition", *(reason.value for reason in Reason)])
    yield line(["---"] * (1 + len(Reason)))
    for name, drives in measured_on.items():
        variant = Variant("default")
        results = [
            run for drive in drives for run in detect(variant, LoopConfig.threshold, drive)[1]
        ]
        counts = Counter(result.reason for result in results)
        yield line([name, *(str(counts[reason]) for reason in Reason)])
    yield ""


def sweep(variant: Variant, drives: Sequence[Drive]) -> PrecisionRecall:
    """The curve of a detector, by a run of all of it at each threshold."""
    scores = [total(variant, threshold, drives) for threshold in variant.thresholds]
    return PrecisionRecall(
        accepted=np.array([score.accepted for score in scores], float),
        true_positives=np.array([score.right for score in scores], float),
        positives=np.array(float(scores[0].revisits)),
        thresholds=np.array(variant.thresholds),
    )


def figures(variant: Variant, threshold: float, drives: Sequence[Drive]) -> list[str]:
    score = total(variant, threshold, drives)
    wrong = score.accepted - score.right
    return [str(score.accepted), str(wrong), f"{score.precision:.3f}", f"{score.recall:.3f}"]


def total(variant: Variant, threshold: float, drives: Sequence[Drive]) -> LoopScore:
    """The counts of some drives together."""
    scores = [detect(variant, threshold, drive)[0] for drive in drives]
    return LoopScore(*np.sum(scores, axis=0).tolist())


def detect(variant: Variant, threshold: float, drive: Drive) -> tuple[LoopScore, list[LoopResult]]:
    """Shows a drive to a detector."""
    config = replace(LoopConfig(), threshold=threshold, **variant.settings)
    detector = LoopDetector(config, head(), variant.pose_gate, variant.geometry)
    results = [
        detector.observe(
            FrameRecord("tour", f"{row:06d}", LABELS_AS, 240, 320, "", *drive.odometry[row]),
            descriptor,
            keypoints=drive.keypoints[row],
        )
        for row, descriptor in enumerate(drive.descriptors)
    ]
    loops = loops_of(detector, results)
    return score_loops(loops, drive.poses, config.exclude, METRES), results


def all_drives(cities: Sequence[int]) -> Runs:
    return {
        name: [render(city, conditions) for city in cities]
        for name, conditions in CONDITIONS.items()
    }


def render(city: int, conditions: Conditions) -> Drive:
    traverse = SyntheticCity(city, TOUR_ESTATES).traverse(5000, conditions, turns=TOUR)
    frames = list(traverse)
    poses = np.array([frame.pose for frame in frames])
    descriptors: list[Tensor] = []
    keypoints: list[KeyPoints] = []
    for start in range(0, len(frames), BATCH):
        labels = np.stack([frame.labels for frame in frames[start : start + BATCH]])
        seen = head().explain(torch.from_numpy(labels))
        descriptors.append(seen.descriptor)
        keypoints += [points.nonzero().numpy().astype(np.int16) for points in seen.keypoints]
    print(f"city {city}: {len(frames)} frames", flush=True)
    return Drive(torch.cat(descriptors), keypoints, poses, drifting(poses, city))


@cache
def head() -> SSRVLAD:
    module = SSRVLAD.from_preset("default", labels_as=LABELS_AS)
    module.compile()
    return module


def drifting(poses: np.ndarray, seed: int) -> np.ndarray:
    """The poses as an odometry gives them that errs in scale and, more and more, in heading."""
    rng = np.random.default_rng(seed)
    steps = np.diff(poses[:, 0] + 1j * poses[:, 1])
    turned = np.cumsum(rng.normal(0, np.radians(TURN_ERROR), len(steps)))
    scale = 1 + rng.normal(0, SCALE_ERROR)
    places = poses[0, 0] + 1j * poses[0, 1] + np.cumsum(scale * steps * np.exp(1j * turned))
    drifted = poses.copy()
    drifted[1:] = np.stack((places.real, places.imag, poses[1:, 2] + turned), axis=1)
    return drifted


def line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
