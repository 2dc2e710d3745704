"""The time of `encode` on one core, of its halves (reading and describing), and on all cores."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from _markdown import head_row, row, span
from _timing import Timing, heads, time_in_turn
from PIL import Image
from torch import Tensor

from ssrvlad_torch import SSRVLAD, SSRVLADConfig
from ssrvlad_torch.channels.label_shapes import LabelShapes
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import BATCH, Describer, Item, encode_to_database, read
from ssrvlad_torch.encoding.results import EncodeOptions

FRAMES = 1000
WORKERS = os.cpu_count() or 1


def encoding_table(maps: Tensor, config: SSRVLADConfig, repetitions: int) -> Iterator[str]:
    """The table, of so many files with the label maps in turn."""
    yield from head_row("describes", "way", "ms a frame", "relative to read + describe")
    with tempfile.TemporaryDirectory() as folder:
        for number in range(FRAMES):
            Image.fromarray(maps[number % len(maps)].numpy()).save(f"{folder}/{number}.png")
        files = find_label_files([folder])
        for who, head in reversed(heads(config).items()):
            timings = _in_turn(head, files, repetitions)
            read_only, describe_only, *_ = (timing.seconds for timing in timings.values())
            both = Timing(tuple(map(sum, zip(read_only, describe_only, strict=True))))
            for name, timing in timings.items():
                each = Timing(tuple(seconds / FRAMES for seconds in timing.seconds))
                ratio = span(both.times_faster_than(timing), 2)
                yield row(who, name, span(each.milliseconds, 2), ratio)


def _in_turn(head: SSRVLAD, files: Sequence[FrameFile], repetitions: int) -> dict[str, Timing]:
    """The halves with the frames in memory, and the whole with writing and flushing; by workers
    after the first batch, without their start."""
    items = [Item(file) for file in files]
    batches = [items[first : first + BATCH] for first in range(0, len(items), BATCH)]
    ready = [read(head.label_space, batch) for batch in batches]
    describer = Describer([LabelShapes(head)], head.label_space)
    starts = list[float]()
    by_workers = f"`ssrvlad encode`, {WORKERS} cores"
    ways: dict[str, Callable[[], object]] = {
        "read only, one core": lambda: [read(head.label_space, batch) for batch in batches],
        "describe only, one core": lambda: [describer(batch) for batch in ready],
        "`ssrvlad encode`, one core": partial(_encode, head, files, 0),
        by_workers: lambda: starts.append(_encode(head, files, WORKERS)),
    }
    timings = time_in_turn(ways, repetitions)
    whole = zip(timings[by_workers].seconds, starts[-repetitions:], strict=True)
    return timings | {by_workers: Timing(tuple(taken - start for taken, start in whole))}


def _encode(head: SSRVLAD, files: Sequence[FrameFile], workers: int) -> float:
    """Encodes; the seconds until the first frame is done."""
    began, first = time.perf_counter(), list[float]()

    def progress(done: int) -> None:
        if done and not first:
            first.append(time.perf_counter() - began)

    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db", head.config)
        encode_to_database(head, files, database, EncodeOptions(workers, progress=progress))
    return first[0]
