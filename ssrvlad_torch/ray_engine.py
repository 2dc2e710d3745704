"""Encoding by Ray Data, on this machine or on all of a cluster. It needs the extra ``ray``."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import torch

from . import encoding
from .config import SSRVLADConfig
from .database import Database
from .datasets.frame_files import FrameFile
from .descriptor import SSRVLAD
from .encoding import Encoded, Summary, encode, encode_to_database
from .parts import Part, schema, to_table, write_part

if TYPE_CHECKING:
    from ray.data import Dataset

_Batch = dict[str, Any]


def encode_with_ray(
    config: SSRVLADConfig, files: Sequence[FrameFile], database: Database, workers: int = 2
) -> Summary:
    """Encodes the frames that a database lacks with Ray, and adds them in one commit.

    The files and the database's folder must be where every node of the cluster finds them. What
    is to become one part is one row of a Ray data set: actors encode it, a task writes it under a
    name that only depends on its number, so that a task that runs twice writes the same part
    twice. Nothing counts until the manifest is written at the end; what a lost worker had in hand
    is done again. Frames whose file has changed are encoded here.

    Args:
        config: must have the database's fingerprint.
        files: from `find_label_files`.
        database: where the raw descriptors go; locked meanwhile.
        workers: number of actors, one core each.

    Raises:
        ValueError: the fingerprints differ, or another process writes to the database.
        ImportError: the extra ``ray`` is not installed.
        OSError: the database cannot be written.
    """
    try:
        import ray.data
    except ImportError as error:
        raise ImportError("--engine ray needs: pip install ssrvlad-torch[ray]") from error
    database.require(config)
    with database.writing():
        known = database.known().rows
        fresh = [file for file in files if file.frame not in known]
        size = encoding.PART_ROWS
        rows = [
            {"part": database.part_name(number), "files": pickle.dumps(fresh[first : first + size])}
            for number, first in enumerate(range(0, len(fresh), size))
        ]
        parts = (
            _run(
                ray.data.from_items(rows, override_num_blocks=len(rows)),
                config,
                database.path,
                workers,
            )
            if rows
            else []
        )
        empty = database.adopt(parts)
        summary = encode_to_database(SSRVLAD(config), files, database, workers)
    added = sum(part.rows for part in parts)
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
    """Writes rows as a part; what `map` makes a task of. A part without rows is none."""
    table = pa.ipc.open_stream(row["rows"]).read_all()
    if not len(table):
        return Part(row["part"], 0, 0, "")._asdict()
    return write_part(folder, row["part"], table)._asdict()


def _run(rows: Dataset, config: SSRVLADConfig, folder: Path, workers: int) -> list[Part]:
    encoded = rows.map_batches(
        PartEncoder,
        fn_constructor_args=(config,),
        batch_size=1,
        concurrency=workers,
        num_cpus=1,
    )
    written = encoded.map(partial(write_rows, folder=folder.absolute()), num_cpus=0)
    parts = [Part(**row) for row in written.take_all()]
    return sorted(part for part in parts if part.rows)
