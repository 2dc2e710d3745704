"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count

import numpy as np
from _markdown import head_row, row

from ssrvlad_torch import SSRVLAD, LoopConfig
from ssrvlad_torch.loops.memory import Memory
from ssrvlad_torch.loops.tracker import Tracker

SIZES = (10_000, 100_000, 1_000_000)
DRIVES, ANCHORS, WARM_UP, FRAMES = 10, 3, 3, 40

Floats = np.ndarray


def loops_table(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """A row for each number of frames in the map."""
    yield from head_row("frames", "search", "step", "step / search")
    for size in sizes:
        search, step = (1e3 * np.array(each) for each in timed(size))
        low, middle, high = np.quantile(step / search, (0.25, 0.5, 0.75))
        times = (f"{np.median(each):.2f}" for each in (search, step))
        yield row(str(size), *times, f"{middle:.2f} [{low:.2f}, {high:.2f}]")


def timed(size: int) -> tuple[list[float], ...]:
    """Seconds of a search and of a step for each frame."""
    memory = Memory(SSRVLAD().config.length)
    drive = size // DRIVES
    rng = np.random.default_rng(0)
    for number, vector in zip(range(size), vectors(rng), strict=False):
        if number % drive == 0:
            memory.start_sequence()
        memory.append(f"{number // drive}/{number}", [np.nan] * 3, vector)
    memory.start_sequence()
    tracker = Tracker(LoopConfig(), memory, {})
    found: tuple[list[float], ...] = ([], [])
    for number in range(WARM_UP + FRAMES):
        [seen] = memory.descriptors(size - drive + number, size - drive + number + 1)
        vector = unit(seen + 0.01 * rng.standard_normal(len(seen), dtype=np.float32))
        swept = np.repeat(vector[None], ANCHORS, axis=0)
        works: tuple[Callable[[], object], ...] = (
            lambda swept=swept: memory.scores(swept),
            lambda swept=swept, number=number: tracker.step(f"now/{number}", swept, {}),
        )
        for times, work in zip(found, works, strict=True):
            begin = time.process_time()
            work()
            if number >= WARM_UP:
                times.append(time.process_time() - begin)
        memory.append(f"now/{number}", [np.nan] * 3, vector)
    return found


def vectors(rng: np.random.Generator) -> Iterator[Floats]:
    """Unit vectors that have something in common."""
    length = SSRVLAD().config.length
    common = rng.standard_normal(length, dtype=np.float32)
    for _ in count():
        yield unit(common + rng.standard_normal(length, dtype=np.float32))


def unit(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector)
