#!/usr/bin/env python3
"""Prints the time per frame of a live stream as the map grows: a section of `benchmark.py`.

.venv/bin/python scripts/pages/bench_loops.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
import torch
from _markdown import head_row, paragraph, row

from ssrvlad_torch import SSRVLAD, Database, LoopDetector
from ssrvlad_torch.cli.bench import threads
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.loops.config import LoopConfig

SIZES = (10_000, 100_000)
LAST = 500
EXCLUDE = LoopConfig.exclude

Floats = np.ndarray
Update = Callable[[int, Floats], object]
"""Takes a frame's number and descriptor."""


def loops_section(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """Lines of the section, in Markdown."""
    stream = drive(sizes[-1])
    yield "## Loop closures, online\n"
    yield paragraph(
        f"A stream of {sizes[-1]} descriptors, every place seen five times. Milliseconds per "
        f"update, one thread: median and maximum of the last {LAST} updates before a size. The "
        "detector is loaded from a database of the frames before them. The plain loop only finds "
        "the best score; the detector also standardises, follows the stream and stores the frame."
    )
    kinds = [f"{size} frames: {kind}" for size in sizes for kind in ("median", "worst")]
    yield from head_row("way", *kinds)
    for name, make in {"LoopDetector": detector, "plain loop": doubling}.items():
        yield row(name, *(cell for size in sizes for cell in figures(make, stream[:size])))
    yield ""


def drive(frames: int) -> Floats:
    """``(frames, D)`` unit vectors: the same places five times, a little different."""
    rng, length = np.random.default_rng(0), SSRVLAD().config.length
    places = rng.standard_normal((-(-frames // 5), length), dtype=np.float32)
    stream = np.concatenate([places] * 5)[:frames]
    for begin in range(0, frames, 1000):
        stream[begin : begin + 1000] += 0.3 * rng.standard_normal((1, length), dtype=np.float32)
    stream /= np.linalg.norm(stream, axis=1, keepdims=True)
    return stream


def record(number: int) -> FrameRecord:
    return FrameRecord("drive", f"{number}")


def detector(seen: Floats) -> Update:
    head = SSRVLAD()
    with TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db", head.config)
        database.append([record(number) for number in range(len(seen))], torch.from_numpy(seen))
        loops = LoopDetector.load(database, head=head)

    def update(number: int, descriptor: Floats) -> object:
        return loops.observe(record(number), torch.from_numpy(descriptor))

    return update


def doubling(seen: Floats) -> Update:
    """A plain loop: a matrix with spare rows, copied when it is full."""
    room = np.empty((1 << (len(seen) - 1).bit_length(), seen.shape[1]), np.float32)
    room[: len(seen)] = seen

    def update(number: int, descriptor: Floats) -> object:
        nonlocal room
        best = int((room[: number - EXCLUDE] @ descriptor).argmax())
        if number == len(room):
            wider = np.empty((2 * number, len(descriptor)), np.float32)
            wider[:number] = room
            room = wider
        room[number] = descriptor
        return best

    return update


def figures(make: Callable[[Floats], Update], stream: Floats) -> list[str]:
    """Median and worst of the last updates of a stream."""
    first = len(stream) - LAST
    update = make(stream[:first])
    return cells([timed(partial(update, *frame)) for frame in enumerate(stream[first:], first)])


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def cells(seconds: list[float]) -> list[str]:
    return [f"{1e3 * taken:.2f}" for taken in (median(seconds), max(seconds))]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    with threads(1):
        for text in loops_section():
            print(text, flush=True)
