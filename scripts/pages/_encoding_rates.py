"""The time of encoding on one core, of its halves (reading and describing), and on all cores."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from ssrvlad_torch.cli.bench import Timing, time_in_turn
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.descriptor import SSRVLAD
from ssrvlad_torch.encoding.describer import BATCH, Describer, Item, read
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.results import EncodeOptions


def encoding_rates(
    head: SSRVLAD, files: Sequence[FrameFile], workers: int, repetitions: int = 5
) -> tuple[dict[str, Timing], list[float]]:
    """Times the halves and the whole in turn, over the same label maps, all in memory together.

    Returns:
        Timings: ``"read"``, ``"describe"``, ``"one"``, `encode_to_database` on one core with
        writing and flushing; ``"all"``, by workers, after the first batch. And the seconds until
        the first batch is done, in which the workers start.
    """
    items = [Item(file) for file in files]
    batches = [items[first : first + BATCH] for first in range(0, len(items), BATCH)]
    ready = [read(head.label_space, batch) for batch in batches]
    describer, starts = Describer(head), list[float]()
    ways: dict[str, Callable[[], object]] = {
        "read": lambda: [read(head.label_space, batch) for batch in batches],
        "describe": lambda: [describer(batch) for batch in ready],
        "one": partial(_all, head, files, 0),
        "all": lambda: starts.append(_all(head, files, workers)),
    }
    timings = time_in_turn(ways, repetitions)
    starts = starts[-repetitions:]
    whole = [a - b for a, b in zip(timings["all"].seconds, starts, strict=True)]
    return {**timings, "all": Timing(tuple(whole))}, starts


def _all(head: SSRVLAD, files: Sequence[FrameFile], workers: int) -> float:
    """Encodes; the seconds until the first frame is done."""
    began, first = time.perf_counter(), list[float]()
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db", head.config)

        def progress(done: int) -> None:
            if done and not first:
                first.append(time.perf_counter() - began)

        encode_to_database(head, files, database, EncodeOptions(workers, progress=progress))
    return first[0]
