"""The time per frame of a live stream as the map grows: a section of `benchmark.py`."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from _markdown import head_row, row

from ssrvlad_torch.native.loops import Channel, Loops
from ssrvlad_torch.stages.features import SHAPE

SIZES = (10_000, 100_000, 1_000_000)
DRIVES, ANCHORS, WARM_UP, FRAMES, LENGTH = 10, 3, 3, 40, 480
CHANNELS = (
    Channel("ssr-vlad", (LENGTH,)),
    Channel("features", SHAPE, "uint8"),
    Channel("hog", (LENGTH,)),
)


def loops_table(sizes: Sequence[int] = SIZES) -> Iterator[str]:
    """A row for each number of frames in the map."""
    yield from head_row("frames", "step", "step, all channels", "greatest", "first after loading")
    for size in sizes:
        alone, times = timed(size, CHANNELS[:1]), timed(size, CHANNELS)
        steps = times[WARM_UP:]
        shown = (np.median(alone[WARM_UP:]), np.median(steps), max(steps), times[0])
        yield row(str(size), *(f"{1e3 * seconds:.2f}" for seconds in shown))


def timed(size: int, channels: Sequence[Channel]) -> list[float]:
    """The seconds of steps by some channels, of random values, around that number of frames; among
    them the first frame of a sequence."""
    stream = Loops(channels)
    rng, stored = np.random.default_rng(0), dict[str, np.ndarray]()
    block = -(-size // 8)  # so many at once are prepared for the first step
    for first in range(0, size - FRAMES // 2, block):
        count = min(block, size - FRAMES // 2 - first)
        stored = {channel.name: drawn(rng, count, channel) for channel in channels}
        stream.extend(stored, None, (first + np.arange(count)) % (size // DRIVES) == 0)
    times: list[float] = []
    for number in range(WARM_UP + FRAMES):
        one = {channel.name: drawn(rng, 1, channel)[0] for channel in channels}
        one["ssr-vlad"] = np.repeat(one["ssr-vlad"][None], ANCHORS, axis=0)
        began = time.process_time()
        stream.update(one, starts=number == FRAMES, threads=torch.get_num_threads())
        times.append(time.process_time() - began)
    return times


def drawn(rng: np.random.Generator, count: int, channel: Channel) -> np.ndarray:
    """Random descriptors of frames by a channel."""
    if channel.dtype == "uint8":
        return rng.integers(0, 256, (count, *channel.shape), np.uint8)
    vectors = rng.standard_normal((count, *channel.shape), np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
