#!/usr/bin/env python3
"""Writes docs/pose-graph.md: tours of synthetic cities with drifting odometry, corrected by loops.

    .venv/bin/python scripts/pages/pose_graphs.py --data ../shared/data

Loops are those of `LoopDetector` with its defaults, `export/pose_graph.py` corrects. How loops err
is measured on other cities. Real pictures of ``--data`` show where local features verify a loop.
Descriptors of cities are cached, as for `loops.py`. Needs the extra `dev`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from _markdown import ROOT, Page, head_row, parser, row, save
from _timing import threads
from _tours import Tour, all_tours, head
from conditions import ROUTES
from PIL import Image

from ssrvlad_torch import LoopDetector
from ssrvlad_torch.database.frames import FrameRecord

sys.path.append(str(ROOT / "export"))
import pose_graph
from pose_graph import Loop, correct, moved, relative

LEARNED_ON, MEASURED_ON, SEEDS = range(100, 104), range(6), range(3)
APART = 30.0
DRIFTS = {"usual": 1.0, "strong": 4.0}
"""Factors of the errors below."""
SCALE, BIAS, STEP, TURN = 0.01, math.radians(0.002), 0.02, math.radians(0.15)
"""Of a drive: its scale, and radians a metre. Of a step: metres after a metre, and radians."""
PAIRS = ("evening -> day", "right -> left", "night -> right")
EVERY, ELSEWHERE = 5, 40


def main() -> None:
    options = parser(__doc__, "pose-graph.md", "loops").parse_args()
    with threads(1):
        page = Page("pose-graph.md", options.output)
        learned = all_tours(LEARNED_ON, options.cache)
        page.table("## How loops err\n", errors_table(learned))
        page.table("## Local features\n", verified_table(options.data))
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


def errors_table(tours: dict[str, list[Tour]]) -> Iterator[str]:
    """How accepted loops err: mean, deviation and quantiles, and how alike neighbours are."""
    yield from head_row("labels", "error", "mean", "deviation", "5 %", "95 %", "alike")
    for condition, drives in tours.items():
        rows = [(tour, loop) for tour in drives for loop in loops_of(tour)]
        seen = np.stack([relative(t.poses[x.candidate], t.poses[x.frame]) for t, x in rows])
        ahead = np.array([x.ahead for _, x in rows], float)
        frames, cities = np.array([(x.frame, tour.city) for tour, x in rows]).T
        kinds = {
            "along, m": seen[:, 0],
            "along, with `ahead`, m": seen[:, 0] - ahead,
            "sideways, m": seen[:, 1],
            "heading, degrees": np.degrees(seen[:, 2]),
        }
        for name, error in kinds.items():
            low, high = np.quantile(error, (0.05, 0.95))
            cells = (error.mean(), error.std(), low, high, alike(error, frames, cities))
            yield row(condition, name, *(f"{value:.2f}" for value in cells))


def alike(error: np.ndarray, frames: np.ndarray, cities: np.ndarray) -> float:
    """How many loops in a row have the information of one: 1 and twice the correlations of loops
    up to 10 frames apart."""
    centred, total = error - error.mean(), 1.0
    for lag in range(1, 11):
        near = (frames[lag:] - frames[:-lag] == lag) & (cities[lag:] == cities[:-lag])
        total += 2 * float((centred[lag:] * centred[:-lag])[near].mean() / error.var())
    return total


def verified_table(data: Path) -> Iterator[str]:
    """Pairs of pictures whose turn local features measure: of one place, and of two."""
    yield from head_row("pictures", "of one place", "verified", "of two places", "verified")
    for name in PAIRS:
        pictures = [sorted((data / folder / "images").iterdir()) for folder in ROUTES[name][:2]]
        counts = list[str]()
        for apart in (0, ELSEWHERE):
            both = [*zip(pictures[1][apart:], pictures[0], strict=False)][::EVERY]
            turns = [pose_graph.verified(Loop(0, 0), each, camera(each[0])).turn for each in both]
            counts += [str(len(turns)), str(sum(turn is not None for turn in turns))]
        yield row(name, *counts)


def camera(picture: Path) -> Sequence[float]:
    """Intrinsics of a camera that sees 64 degrees, for those of these drives are not known."""
    width, height = Image.open(picture).size
    return 0.8 * width, 0.8 * width, width / 2, height / 2


if __name__ == "__main__":
    main()
