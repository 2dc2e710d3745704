#!/usr/bin/env python3
"""Prints what a frame of a live stream costs as the map grows; `benchmark.py` has it as a section.

.venv/bin/python scripts/bench_loops.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from statistics import median

import numpy as np
import torch

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.bench import threads
from ssrvlad_torch.database import FrameRecord
from ssrvlad_torch.loop_closure import LoopDetector
from ssrvlad_torch.loop_config import LoopConfig

FRAMES = 100_000
LENGTH = 480
LAST = 500
"""The median is over so many updates."""
SLOW = 5
"""Updates that are timed of a way that copies or visits the whole map in Python."""
EXCLUDE = LoopConfig.exclude

Floats = np.ndarray
Update = Callable[[int, Floats], object]
"""Takes a frame's number and descriptor."""


def loops_section(frames: int = FRAMES) -> Iterator[str]:
    """Lines of the section, in Markdown."""
    stream = drive(frames)
    sizes = [frames // 100, frames // 10, frames]
    yield "## Loop closures, online\n"
    yield f"A stream of {frames} descriptors, every place seen five times; milliseconds an update,"
    yield f"one thread: median of the {LAST} updates up to a size, and the slowest of all updates"
    yield "since the size before. A plain loop keeps the best score only; the detector sums over"
    yield "time, checks the candidate and remembers the frame. Where the whole map is copied or"
    yield f"visited in Python, {SLOW} updates stand for all.\n"
    columns = ["way", *(f"{size} frames: {kind}" for size in sizes for kind in ("median", "worst"))]
    yield line(*columns)
    yield line(*["---"] * len(columns))
    for name, make in {"LoopDetector": detector, "NumPy, array that doubles": doubling}.items():
        yield line(name, *figures(seconds(make(), stream), sizes))
    for name, update in {"NumPy, list stacked": stacked, "NumPy, row by row": row_by_row}.items():
        cells: list[str] = []
        for size in sizes:
            seen = list(stream[:size])
            taken = [timed(partial(update, seen, stream[-1])) for _ in range(SLOW)]
            cells += [milliseconds(median(taken)), milliseconds(max(taken))]
        yield line(name, *cells)
    yield ""


def drive(frames: int) -> Floats:
    """``(frames, LENGTH)`` unit vectors: the same places five times, a little different."""
    rng = np.random.default_rng(0)
    places = rng.standard_normal((-(-frames // 5), LENGTH), dtype=np.float32)
    stream = np.concatenate([places] * 5)[:frames]
    for begin in range(0, frames, 1000):
        stream[begin : begin + 1000] += 0.3 * rng.standard_normal((1, LENGTH), dtype=np.float32)
    return stream / np.linalg.norm(stream, axis=1, keepdims=True)


def detector() -> Update:
    loops = LoopDetector(head=SSRVLAD())

    def update(number: int, descriptor: Floats) -> object:
        record = FrameRecord("drive", str(number), "cityscapes-trainids", 0, 0, "")
        return loops.observe(record, torch.from_numpy(descriptor))

    return update


def doubling() -> Update:
    """What one writes who knows how to: a matrix with room to spare, copied when it is full."""
    seen = np.empty((1, LENGTH), np.float32)

    def update(number: int, descriptor: Floats) -> object:
        nonlocal seen
        old = number - EXCLUDE
        best = int((seen[:old] @ descriptor).argmax()) if old > 0 else -1
        if number == len(seen):
            wider = np.empty((2 * number, LENGTH), np.float32)
            wider[:number] = seen
            seen = wider
        seen[number] = descriptor
        return best

    return update


def stacked(seen: list[Floats], descriptor: Floats) -> int:
    return int((np.stack(seen) @ descriptor).argmax())


def row_by_row(seen: list[Floats], descriptor: Floats) -> int:
    return max(range(len(seen)), key=lambda row: seen[row] @ descriptor)


def seconds(update: Update, stream: Floats) -> list[float]:
    return [timed(partial(update, *frame)) for frame in enumerate(stream)]


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def figures(taken: list[float], sizes: list[int]) -> list[str]:
    cells, before = [], 0
    for size in sizes:
        cells.append(milliseconds(median(taken[max(0, size - LAST) : size])))
        cells.append(milliseconds(max(taken[before:size])))
        before = size
    return cells


def milliseconds(taken: float) -> str:
    return f"{1e3 * taken:.2f}"


def line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--frames", type=int, default=FRAMES)
    with threads(1):
        for text in loops_section(arguments.parse_args().frames):
            print(text, flush=True)
