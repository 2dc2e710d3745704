"""How near encoding comes to the larger of what it cannot do without: reading and describing."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from ssrvlad_torch.cli.bench import Timing, time_in_turn
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.frame_files import FrameFile
from ssrvlad_torch.descriptor import SSRVLAD
from ssrvlad_torch.encoding.encoder import (
    BATCH,
    BATCHES_OF_A_CHUNK,
    describe_only,
    encode_to_database,
    read_only,
)
from ssrvlad_torch.encoding.workers import in_order


def encoding_rates(
    head: SSRVLAD, files: Sequence[FrameFile], workers: int, repetitions: int = 5
) -> dict[str, Timing]:
    """Times the halves and the whole in turn, over the same files with the same workers.

    Args:
        head: on the CPU.
        files: label maps, best some thousands, that fit in memory together.
        workers: number of processes of each way.
        repetitions: how often.

    Returns:
        ``"decode"``, reading and digesting label maps; ``"encode"``, describing those that lie in
        memory; ``"all"``, what `encode_to_database` does, writing and flushing among it.
    """
    size = BATCH * BATCHES_OF_A_CHUNK
    chunks = [files[first : first + size] for first in range(0, len(files), size)]
    in_memory = [read_only(head, chunk) for chunk in chunks]

    def describe(number: int) -> int:
        return len(describe_only(head, in_memory[number]))

    ways: dict[str, Callable[[], object]] = {
        "decode": lambda: sum(in_order(lambda c: len(read_only(head, c)), chunks, workers)),
        "encode": lambda: sum(in_order(describe, range(len(chunks)), workers)),
        "all": partial(_all, head, files, workers),
    }
    return time_in_turn(ways, repetitions)


def _all(head: SSRVLAD, files: Sequence[FrameFile], workers: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        database = Database.create(Path(folder) / "db", head.config)
        encode_to_database(head, files, database, workers)
