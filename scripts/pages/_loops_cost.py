"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from _markdown import head_row, row

from ssrvlad_torch.native.loops import SCAN_ABOVE, Channel, Loops
from ssrvlad_torch.recognition.matching import Rows
from ssrvlad_torch.recognition.sweep import score
from ssrvlad_torch.stages.features import SHAPE

SIZES = (10_000, 100_000, 1_000_000)
NEVER = 1 << 62
"""Old frames that no stream has."""
DRIVES, ANCHORS, WARM_UP, FRAMES, LENGTH, BLOCK = 10, 3, 3, 40, 480, 1000
CHANNELS = (
    Channel("ssr-vlad", (LENGTH,)),
    Channel("features", SHAPE, "uint8"),
    Channel("hog", (LENGTH,)),
)


def loops_table(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """A row for each number of frames in the map."""
    names = "frames", "search", "step", "step / search", "step, all channels"
    yield from head_row(*names, "all rows by all of them")
    for size in sizes:
        search, step = 1e3 * timed(size).T
        low, middle, high = np.quantile(step / search, (0.25, 0.5, 0.75))
        times = (f"{np.median(each):.2f}" for each in (search, step))
        ratio = f"{middle:.2f} [{low:.2f}, {high:.2f}]"
        steps = (timed_with_all_channels(size, above) for above in (SCAN_ABOVE, NEVER))
        yield row(str(size), *times, ratio, *(f"{1e3 * step:.2f}" for step in steps))


def timed(size: int) -> np.ndarray:
    """``(FRAMES, 2)`` seconds of an exact search and of a step. All rows of the map have something
    in common."""
    rng, drive = np.random.default_rng(0), size // DRIVES
    common = rng.standard_normal(LENGTH, dtype=np.float32)
    vectors = np.empty((size, LENGTH), np.float32)
    for number in range(size):
        vectors[number] = unit(common + rng.standard_normal(LENGTH, dtype=np.float32))
    stream, rows = Loops([Channel("ssr-vlad", (LENGTH,))]), Rows.of(torch.from_numpy(vectors))
    stream.extend({"ssr-vlad": vectors}, None, np.arange(size) % drive == 0)
    taken: list[np.ndarray] = []
    for number in range(WARM_UP + FRAMES):
        seen = vectors[size - drive + number]
        vector = unit(seen + 0.01 * rng.standard_normal(LENGTH, dtype=np.float32))
        swept = np.repeat(vector[None], ANCHORS, axis=0)
        times = [time.process_time()]
        score(swept[None], rows)
        times.append(time.process_time())
        stream.update({"ssr-vlad": swept}, starts=number == 0, threads=torch.get_num_threads())
        times.append(time.process_time())
        if number >= WARM_UP:
            taken.append(np.diff(times))
    return np.array(taken)


def timed_with_all_channels(size: int, scan_above: int = SCAN_ABOVE) -> float:
    """The median of the seconds of a step by label maps, features and HOG, of random values."""
    stream = Loops(CHANNELS, scan_above=scan_above)
    rng, known = np.random.default_rng(0), dict[str, np.ndarray]()
    for first in range(0, size, BLOCK):
        count = min(BLOCK, size - first)
        known = {channel.name: drawn(rng, count, channel) for channel in CHANNELS}
        stream.extend(known, None, (first + np.arange(count)) % (size // DRIVES) == 0)
    times: list[float] = []
    for number in range(WARM_UP + FRAMES):
        one = {name: values[number] for name, values in known.items()}
        one["ssr-vlad"] = np.repeat(one["ssr-vlad"][None], ANCHORS, axis=0)
        began = time.process_time()
        stream.update(one, starts=number == 0, threads=torch.get_num_threads())
        times.append(time.process_time() - began)
    return float(np.median(times[WARM_UP:]))


def drawn(rng: np.random.Generator, count: int, channel: Channel) -> np.ndarray:
    """Random descriptors of frames by a channel."""
    if channel.dtype == "uint8":
        return rng.integers(0, 256, (count, *channel.shape), np.uint8)
    vectors = rng.standard_normal((count, *channel.shape), np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
