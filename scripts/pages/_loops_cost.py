"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
from _markdown import head_row, row

from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.database.frames import FrameRecord
from ssrvlad_torch.loops.config import LoopConfig
from ssrvlad_torch.loops.memory import Memory
from ssrvlad_torch.loops.tracker import Tracker

SIZES = (10_000, 100_000, 1_000_000)
DRIVES, ANCHORS, WARM_UP, FRAMES = 10, 3, 3, 40


def loops_table(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """A row for each number of frames in the map."""
    yield from head_row("frames", "search", "step", "step / search")
    for size in sizes:
        search, step = 1e3 * timed(size).T
        low, middle, high = np.quantile(step / search, (0.25, 0.5, 0.75))
        times = (f"{np.median(each):.2f}" for each in (search, step))
        yield row(str(size), *times, f"{middle:.2f} [{low:.2f}, {high:.2f}]")


def timed(size: int) -> np.ndarray:
    """``(FRAMES, 2)`` seconds of a search and of a step. All rows of the map have something in
    common."""
    channel, rng, drive = LabelShapes(), np.random.default_rng(0), size // DRIVES
    name, length = channel.name, channel.length
    memory = Memory([channel])
    live = memory.lives[name]
    common = rng.standard_normal(length, dtype=np.float32)
    for number in range(size):
        if number % drive == 0:
            memory.start_stretch()
        vector = unit(common + rng.standard_normal(length, dtype=np.float32))
        memory.append(FrameRecord(f"{number // drive}", f"{number}"), {name: vector})
    memory.start_stretch()
    tracker = Tracker(LoopConfig(), memory)
    taken: list[np.ndarray] = []
    for number in range(WARM_UP + FRAMES):
        [seen] = live.descriptors(size - drive + number, size - drive + number + 1)
        vector = unit(seen + 0.01 * rng.standard_normal(length, dtype=np.float32))
        swept = np.repeat(vector[None], ANCHORS, axis=0)
        times = [time.process_time()]
        live.scores(swept)
        times.append(time.process_time())
        tracker.step(f"now/{number}", {name: swept})
        times.append(time.process_time())
        if number >= WARM_UP:
            taken.append(np.diff(times))
        memory.append(FrameRecord("now", f"{number}"), {name: vector})
    return np.array(taken)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
