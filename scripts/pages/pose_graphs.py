#!/usr/bin/env python3
"""Writes docs/pose-graph.md: tours of synthetic cities with drifting odometry, corrected by loops.

    .venv/bin/python scripts/pages/pose_graphs.py

Loops are those of `LoopDetector` with its defaults, `export/pose_graph.py` corrects. Descriptors
of cities are cached, as for `loops.py`. Needs the extra `dev`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from _markdown import ROOT, Page, head_row, parser, row, save
from _timing import threads
from _tours import Tour, all_tours, head

from ssrvlad_torch import LoopDetector
from ssrvlad_torch.database.frames import FrameRecord

sys.path.append(str(ROOT / "export"))
import pose_graph
from pose_graph import Loop, correct, moved, relative

MEASURED_ON, SEEDS = range(6), range(3)
APART = 30.0
DRIFTS = {"usual": 1.0, "strong": 4.0}
"""Factors of the errors below."""
SCALE, BIAS, STEP, TURN = 0.01, math.radians(0.002), 0.02, math.radians(0.15)
"""Of a drive: its scale, and radians a metre. Of a step: metres after a metre, and radians."""


def main() -> None:
    options = parser(__doc__, "pose-graph.md", "loops", needs_data=False).parse_args()
    with threads(1):
        page = Page("pose-graph.md", options.output)
        measured = all_tours(MEASURED_ON, options.cache)
        page.table("## Before and after\n", table(measured, options.output.parent / "figures"))


def table(tours: dict[str, list[Tour]], figures: Path) -> Iterator[str]:
    """Trajectory errors before and after, without wrong loops and with some."""
    closed = {name: [(tour, loops_of(tour)) for tour in drives] for name, drives in tours.items()}
    cases = {"": (0.0, 1), "5 % wrong": (0.05, 1), "5 % in one run": (0.05, 0), "20 %": (0.2, 10)}
    yield from head_row(
        *("labels", "drift", "wrong loops added", "before, m", "after, m", "worst after, m"),
        *("without refusing, m", "right refused", "wrong kept"),
    )
    for condition, (drift, factor) in product(tours, DRIFTS.items()):
        runs = [
            partial(trial, t, loops, seed, factor)
            for t, loops in closed[condition]
            for seed in SEEDS
        ]
        for name, (part, run) in cases.items():
            found = np.array([each(part, run) for each in runs])
            before, after, trusting, refused, kept = found.T
            cells = (before.mean(), after.mean(), after.max(), trusting.mean())
            numbers = [f"{value:.1f}" for value in cells]
            counts = [str(round(each.sum())) for each in (refused, kept)]
            yield row(condition, drift, name or "none", *numbers, *counts)
            print(condition, drift, name, *numbers, *counts, flush=True)
    tour, loops = closed["noisy labels"][0]
    odometry = drifting(tour.poses, 0, DRIFTS["strong"])
    loops = [*loops, *wrong_loops(tour, len(loops) // 20, 1, 0)]
    figure = pose_graph.draw(odometry, correct(odometry, loops, usual(4.0)), loops)
    save(figure, figures / "pose-graph.png")


def trial(
    tour: Tour, right: list[Loop], seed: int, factor: float, part: float, run: int
) -> list[float]:
    """Errors of a drive before and after, and after if all loops are trusted; right loops that were
    refused, and wrong ones that were kept."""
    odometry = drifting(tour.poses, seed, factor)
    many = round(part * len(right))
    loops = right + wrong_loops(tour, many, run or many, seed)
    after, trusting = (
        correct(odometry, loops, usual(factor), robust=robust) for robust in (True, False)
    )
    believed = after.believed >= pose_graph.EVEN
    errors = (
        trajectory_error(each, tour.poses) for each in (odometry, after.poses, trusting.poses)
    )
    return [*errors, (~believed[: len(right)]).sum(), believed[len(right) :].sum()]


def usual(factor: float) -> pose_graph.Odometry:
    """What a user knows of odometry that drifts so."""
    return pose_graph.Odometry(0.02 * factor, math.radians(0.1) * factor)


def drifting(poses: np.ndarray, seed: int, factor: float) -> np.ndarray:
    """``(N, 3)``, odometry of a drive with these true poses."""
    rng, steps = np.random.default_rng(seed), relative(poses[:-1], poses[1:])
    metres = np.hypot(*steps[:, :2].T)
    steps[:, :2] *= 1 + factor * SCALE * rng.standard_normal()
    noise = rng.standard_normal((len(steps), 2)) * np.sqrt(metres)[:, None]
    steps[:, :2] += factor * STEP * noise
    steps[:, 2] += factor * BIAS * rng.standard_normal() * metres
    steps[:, 2] += factor * TURN * rng.standard_normal(len(steps))
    driven = [poses[0]]
    for step in steps:
        driven.append(moved(driven[-1], step))
    return np.array(driven)


def loops_of(tour: Tour) -> list[Loop]:
    """The loops of a detector; `ahead` is by odometry that drifts strongly."""
    detector = LoopDetector(head=head())
    odometry = drifting(tour.poses, 0, DRIFTS["strong"])
    results = [
        detector.observe(FrameRecord("tour", f"{number}", *pose), vector)
        for number, (pose, vector) in enumerate(zip(odometry, tour.descriptors, strict=True))
    ]
    return [
        Loop(number, int(str(result.candidate).rpartition("/")[2]), result.ahead)
        for number, result in enumerate(results)
        if result.accepted
    ]


def wrong_loops(tour: Tour, many: int, run: int, seed: int) -> list[Loop]:
    """Loops between frames far apart, in runs of neighbours that agree with each other."""
    rng, loops, poses = np.random.default_rng(seed), list[Loop](), tour.poses
    while len(loops) < many:
        frame = int(rng.integers(150 + run, len(poses) - run))
        there = int(rng.integers(0, frame - 100 - run))
        if math.dist(poses[frame, :2], poses[there, :2]) > APART:
            loops += [Loop(frame + n, there + n, 0.0) for n in range(run)]
    return loops[:many]


def trajectory_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Root of the mean squared distance in metres, after the best rotation and translation."""
    one, other = (each[:, :2] - each[:, :2].mean(0) for each in (poses, truth))
    left, _, right = np.linalg.svd(one.T @ other)
    turn = left @ np.diag([1, np.linalg.det(left @ right)]) @ right
    return float(np.sqrt(np.square(one @ turn - other).sum(1).mean()))


if __name__ == "__main__":
    main()
