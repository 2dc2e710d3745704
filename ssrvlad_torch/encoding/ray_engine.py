"""Encoding by Ray Data, on this machine or on all of a cluster. It needs the extra ``ray``."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from ..config import SSRVLADConfig
from ..database.database import Database, Written
from ..datasets.frame_files import FrameFile
from ..datasets.remote_files import RemoteFile
from ..descriptor import SSRVLAD
from ..files import one_line
from ..taxonomy import label_space
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

    The files and the database must be where every node of the cluster finds them. What is to
    become one part is one row of a Ray data set: an actor encodes and writes it. Nothing counts
    until the driver commits all at the end, or when the run is interrupted; what a lost worker had
    in hand is done again. Frames whose file has changed are encoded here.

    Args:
        config: must have the database's fingerprint.
        files: from `find_label_files` or `find_remote_files`.
        database: where the raw descriptors go.
        workers: number of actors, one core each.
        progress, complete, prune, refuse: as for `encode_to_database`.

    Raises:
        ValueError: the fingerprints differ.
        ImportError: the extra ``ray`` is not installed.
        OSError: the database cannot be written, or Ray gave up.
    """
    _need_ray()
    database.require(config)
    tell, parts, empty = progress or (lambda _done: None), list[Written](), 0
    known, origin = database.known(), database.add_origin(label_space(config.labels_as))
    fresh = [file for file in files if file.frame not in known]
    try:
        for part, zeros in _parts(config, fresh, database, origin, workers):
            parts.append(part)
            empty += zeros
            tell(len(part.frames))
    finally:
        database.adopt(parts)
    added = sum(len(part.frames) for part in parts)
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
    """Encodes the files of a part and writes its rows; what `map_batches` makes an actor of."""

    def __init__(self, config: SSRVLADConfig, path: str, origin: str) -> None:
        torch.set_num_threads(1)
        self.head = SSRVLAD(config)
        self.database, self.origin = Database.open(path), origin

    def __call__(self, batch: _Batch) -> _Batch:
        """Files, pickled, to what `Database.adopt` takes, the number of zeros, and an error."""
        results = [self._write(pickle.loads(files)) for files in batch["files"]]
        written, empty, error = zip(*results, strict=True)
        return {"written": list(written), "empty": list(empty), "error": list(error)}

    def _write(self, files: Sequence[FrameFile]) -> tuple[bytes, int, str]:
        results = encode(self.head, files, workers=0)
        frames = [result for result in results if isinstance(result, Encoded)]
        if not frames:
            return pickle.dumps(Written((), ())), 0, ""
        descriptors = torch.stack([frame.descriptor for frame in frames])
        records = [frame.record._replace(origin=self.origin) for frame in frames]
        try:
            written = self.database.write_apart(records, descriptors)
        except OSError as refusal:
            return b"", 0, one_line(refusal)
        return pickle.dumps(written), int((~descriptors.any(dim=1)).sum()), ""


def _parts(
    config: SSRVLADConfig,
    files: Sequence[FrameFile],
    database: Database,
    origin: str,
    workers: int,
) -> Iterator[tuple[Written, int]]:
    """What Ray makes of files as it is written, and how many frames of it are empty."""
    import ray.data

    firsts = range(0, len(files), encoding.PART_ROWS)
    if not firsts:
        return
    rows = [{"files": pickle.dumps(files[n : n + encoding.PART_ROWS])} for n in firsts]
    path = str(Path(database.path).absolute())
    _quiet_ray()
    encoded = ray.data.from_items(rows, override_num_blocks=len(rows)).map_batches(
        PartEncoder,
        fn_constructor_args=(config, path, origin),
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=max(1, min(workers, len(rows)))),
        num_cpus=1,
    )
    try:
        for row in encoded.iter_rows():
            if row["error"]:
                raise OSError(row["error"])
            yield pickle.loads(row["written"]), row["empty"]
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
