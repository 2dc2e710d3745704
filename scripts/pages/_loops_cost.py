"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count

import numpy as np
from _markdown import head_row, paragraph, row

from ssrvlad_torch import SSRVLAD, LoopConfig
from ssrvlad_torch.loops.memory import Memory
from ssrvlad_torch.loops.tracker import Tracker

SIZES = (10_000, 100_000, 1_000_000)
DRIVES, ANCHORS, WARM_UP, FRAMES = 10, 3, 3, 40

Floats = np.ndarray


def loops_section(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """Lines of the section, in Markdown."""
    yield "## Loop closures, online\n"
    yield paragraph(
        f"A map of {DRIVES} drives of unlike frames; then the last drive comes again. Milliseconds "
        f"of one core for a frame, median of {FRAMES} frames in turn: the "
        f"*search* (cosines from {ANCHORS} anchors, each drive without its mean), "
        "the *step* of the detector, which has this search in it and follows the stream forwards "
        "and, as a decoy, backwards. The ratio is of each frame, with its quartiles. A row of the "
        "map takes 1920 bytes for its descriptor and about 150 for the filter."
    )
    yield from head_row("frames", "search", "step", "step / search")
    for size in sizes:
        search, step = (1e3 * np.array(each) for each in timed(size))
        low, middle, high = np.quantile(step / search, (0.25, 0.5, 0.75))
        times = (f"{np.median(each):.2f}" for each in (search, step))
        yield row(str(size), *times, f"{middle:.2f} [{low:.2f}, {high:.2f}]")
    yield ""


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
