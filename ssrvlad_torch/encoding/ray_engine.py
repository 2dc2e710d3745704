"""Encoding by Ray Data, on this machine or on all of a cluster. It needs the extra ``ray``."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import torch

from ..config import SSRVLADConfig
from ..database.database import Database
from ..database.storage.parts import Part, one_line, schema, to_table, write_part
from ..datasets.frame_files import FrameFile
from ..datasets.remote_files import RemoteFile
from ..descriptor import SSRVLAD
from . import encoder as encoding
from .encoder import Encoded, Progress, Refusal, Summary, encode, encode_to_database

_Batch = dict[str, Any]


def encode_with_ray(
    config: SSRVLADConfig,
    files: Sequence[FrameFile],
    database: Database,
    workers: int = 2,
    progress: Progress | None = None,
    complete: bool = False,
    prune: bool = False,
    refuse: Callable[[Refusal], None] | None = None,
) -> Summary:
    """Encodes the frames that a database lacks with Ray, and adds them in one commit.

    The files and the database's folder must be where every node of the cluster finds them. What
    is to become one part is one row of a Ray data set: actors encode it, a task writes it under a
    name that only depends on its number, so that a task that runs twice writes the same part
    twice. Nothing counts until the manifest is written at the end, or when the run is interrupted;
    what a lost worker had in hand is done again. Frames whose file has changed are encoded here.

    Args:
        config: must have the database's fingerprint.
        files: from `find_label_files` or `find_remote_files`.
        database: where the raw descriptors go; locked meanwhile.
        workers: number of actors, one core each.
        progress, complete, prune, refuse: as for `encode_to_database`.

    Raises:
        ValueError: the fingerprints differ, or another process writes to the database.
        ImportError: the extra ``ray`` is not installed.
        OSError: the database cannot be written, or Ray gave up.
    """
    _need_ray()
    database.require(config)
    tell, parts = progress or (lambda _done: None), list[Part]()
    with database.writing():
        known = database.known().rows
        fresh = [file for file in files if file.frame not in known]
        try:
            for part in _parts(config, fresh, database, workers):
                parts.append(part)
                tell(part.rows)
        finally:
            empty = database.adopt(sorted(part for part in parts if part.rows))
        added = sum(part.rows for part in parts)
        summary = encode_to_database(
            SSRVLAD(config), files, database,
            0 if any(isinstance(file, RemoteFile) for file in files) else workers,
            _all_but(added, tell), None, complete, prune, refuse,
        )  # fmt: skip
    summary.encoded += added
    summary.already_there -= added
    summary.empty += empty
    return summary


class PartEncoder:
    """Encodes the files of a part; what `map_batches` makes an actor of."""

    def __init__(self, config: SSRVLADConfig) -> None:
        torch.set_num_threads(1)
        self.head = SSRVLAD(config)

    def __call__(self, batch: _Batch) -> _Batch:
        """Files, pickled, to rows in Arrow's stream format."""
        return {"part": batch["part"], "rows": [self._rows(files) for files in batch["files"]]}

    def _rows(self, files: bytes) -> bytes:
        results = encode(self.head, pickle.loads(files), workers=0)
        encoded = [result for result in results if isinstance(result, Encoded)]
        table = schema(self.head.config.length).empty_table()
        if encoded:
            descriptors = torch.stack([frame.descriptor for frame in encoded])
            table = to_table([frame.record for frame in encoded], descriptors)
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        content: bytes = sink.getvalue().to_pybytes()
        return content


def write_rows(row: _Batch, folder: Path) -> _Batch:
    """Writes rows as a part; what `map` makes a task of. A part without rows is none.

    Returns:
        What the manifest says of a part, and ``error``: what the disk says, or nothing.
    """
    table, error = pa.ipc.open_stream(row["rows"]).read_all(), ""
    part = Part(row["part"], 0, 0, "")
    try:
        part = write_part(folder, row["part"], table) if len(table) else part
    except OSError as refusal:
        error = one_line(refusal)
    return {**part._asdict(), "error": error}


def _parts(
    config: SSRVLADConfig, files: Sequence[FrameFile], database: Database, workers: int
) -> Iterator[Part]:
    """The parts that Ray makes of files, as they are written."""
    import ray.data

    firsts = range(0, len(files), encoding.PART_ROWS)
    if not firsts:
        return
    rows = [
        {
            "part": database.part_name(number),
            "files": pickle.dumps(files[first : first + encoding.PART_ROWS]),
        }
        for number, first in enumerate(firsts)
    ]
    _quiet_ray()
    encoded = ray.data.from_items(rows, override_num_blocks=len(rows)).map_batches(
        PartEncoder,
        fn_constructor_args=(config,),
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=max(1, min(workers, len(rows)))),
        num_cpus=1,
    )
    written = encoded.map(partial(write_rows, folder=database.path.absolute()), num_cpus=0)
    try:
        for row in written.iter_rows():
            if error := row.pop("error"):
                raise OSError(error)
            yield Part(**row)
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        raise OSError(f"Ray gave up: {one_line(cause)}") from error


def _all_but(already_told: int, tell: Progress) -> Progress:
    """Progress that passes over so many frames first."""
    left = already_told

    def advance(done: int) -> None:
        nonlocal left
        passed = min(left, done)
        left -= passed
        tell(done - passed)

    return advance


def _need_ray() -> None:
    try:
        import ray.data  # noqa: F401
    except ImportError as error:
        raise ImportError("--engine ray needs: pip install ssrvlad-torch[ray]") from error


def _quiet_ray() -> None:
    """Connects to Ray, if nobody has, without what it tells in passing."""
    import ray.data

    if not ray.is_initialized():
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
        ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    ray.data.DataContext.get_current().enable_progress_bars = False
