"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from _markdown import head_row, row

from ssrvlad_torch.native.loops import SCAN_ABOVE, Channel, Loops
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
    yield from head_row("frames", "step", "step, all channels", "all rows by all of them")
    for size in sizes:
        ways = (CHANNELS[:1], SCAN_ABOVE), (CHANNELS, SCAN_ABOVE), (CHANNELS, NEVER)
        yield row(str(size), *(f"{1e3 * timed(size, *way):.2f}" for way in ways))


def timed(size: int, channels: Sequence[Channel], scan_above: int) -> float:
    """The median of the seconds of a step by some channels, of random values."""
    stream = Loops(channels, scan_above=scan_above)
    rng, stored = np.random.default_rng(0), dict[str, np.ndarray]()
    for first in range(0, size, BLOCK):
        count = min(BLOCK, size - first)
        stored = {channel.name: drawn(rng, count, channel) for channel in channels}
        stream.extend(stored, None, (first + np.arange(count)) % (size // DRIVES) == 0)
    times: list[float] = []
    for number in range(WARM_UP + FRAMES):
        one = {name: values[number] for name, values in stored.items()}
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
