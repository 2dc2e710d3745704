"""Encoding with Ray Data, on this machine or on a cluster; needs the extra ``ray``."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..database.database import Database, StagedRows
from ..datasets.frame_file import FrameFile
from ..datasets.names import absolute, is_uri
from ..descriptor import SSRVLAD
from ..files import one_line
from .describer import Describer, Item
from .interruption import deferred_interruption
from .plan import NEW, Plan
from .results import Encoded, EncodeOptions, Skipped, Summary, cores
from .writer import Writer

PART = 1024
"""Number of frames that are encoded and written together."""

_Batch = dict[str, Any]


class Part(NamedTuple):
    """The results of one part of the frames.

    Attributes:
        results: the results that are not in ``staged``.
        staged: new frames, written to files of the database but not committed.
        empty: number of staged frames that are empty.
    """

    results: list[Encoded | Skipped]
    staged: StagedRows | None = None
    empty: int = 0


def encode_with_ray(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
) -> Summary:
    """Encodes frames as `encode_to_database` does, with Ray.

    Every node of the cluster must be able to open the files and the database. Actors encode new
    frames and write them to files of the database. The caller's process commits these every few
    seconds, at the end, and when the run is interrupted. If an actor is lost, another repeats its
    work. Frames that replace others are sent to the caller's process and written there.

    Args:
        head: its settings must have the database's fingerprint.
        files: from `find_label_files`.
        database: receives the raw descriptors.
        options: as for `encode_to_database`; ``workers`` is the number of actors with one core
            each.

    Raises:
        ValueError: as for `encode_to_database`.
        ImportError: the extra ``ray`` is not installed.
        OSError: the database cannot be written, or Ray failed.
    """
    _require_ray()
    options = options or EncodeOptions()
    database.require(head.config)
    if database.beside:
        raise ValueError(f"{database.path} holds descriptors of pictures; Ray reads label maps")
    with deferred_interruption() as check:
        origin = database.add_origin(head.label_space)
        plan = Plan.of(files, database, database.origins[origin])
        options.progress(plan.already_there)
        path = database.path if is_uri(database.path) else absolute(Path(database.path))
        encoder = PartEncoder(Describer(head, origin), path)
        with Writer(database, plan, options) as writer:
            for part in _parts(encoder, plan, options.workers or cores()):
                if part.staged:
                    writer.add_staged(part.staged, part.empty)
                for result in part.results:
                    writer.add(result)
                check()
        return writer.finish()


class PartEncoder:
    """Encodes the files of a part, and stages new frames in the database at a path."""

    def __init__(self, describer: Describer, database: str) -> None:
        self.describer = describer
        self.database = database

    def __call__(self, files: Sequence[FrameFile], new: bool) -> Part:
        """The results of the files of a part; ``new``: none of its frames is in the database."""
        results = self.describer([Item(file) for file in files])
        described = [result for result in results if isinstance(result, Encoded)]
        if not new or not described:
            return Part(results)
        descriptors = np.stack([result.descriptor for result in described])
        records = [result.record for result in described]
        staged = Database.open(self.database).write_apart(records, descriptors)
        skipped = [result for result in results if isinstance(result, Skipped)]
        return Part([*skipped], staged, int((~descriptors.any(axis=1)).sum()))


class Actor:
    """An actor for `map_batches`: takes pickled files, returns a pickled `Part` or an error."""

    def __init__(self, encoder: PartEncoder) -> None:
        torch.set_num_threads(1)
        self.encode = encoder

    def __call__(self, batch: _Batch) -> _Batch:
        """The batch holds one part."""
        [files], [new] = batch["files"], batch["new"]
        try:
            part: Part | OSError = self.encode(pickle.loads(files), bool(new))
        except OSError as error:  # a disk error: Ray must not retry
            part = OSError(one_line(error))
        except Exception as error:  # the report of Ray would not show it
            part = OSError(f"Ray failed: {one_line(error)}")
        return {"part": [pickle.dumps(part)]}


def _parts(encoder: PartEncoder, plan: Plan, workers: int) -> Iterator[Part]:
    """The results for the files of a plan, as they arrive."""
    import ray.data

    rows = [
        {"files": pickle.dumps(files[first : first + PART]), "new": new}
        for new in (True, False)
        for files in [[file for file in plan.files if (plan.reasons[file.frame] == NEW) == new]]
        for first in range(0, len(files), PART)
    ]
    if not rows:
        return
    _quiet_ray()
    parts = ray.data.from_items(rows, override_num_blocks=len(rows)).map_batches(
        Actor,
        fn_constructor_args=(encoder,),
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=max(1, min(workers, len(rows)))),
        num_cpus=1,
    )
    try:
        for row in parts.iter_rows():
            part = pickle.loads(row["part"])
            if isinstance(part, OSError):
                raise part
            yield part
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        raise OSError(f"Ray failed: {one_line(cause)}") from error


def _require_ray() -> None:
    try:
        import ray.data  # noqa: F401
    except ImportError as error:
        raise ImportError("--engine ray needs: pip install ssrvlad-torch[ray]") from error


def _quiet_ray() -> None:
    """Connects to Ray unless the process is connected, and silences its logs."""
    import ray.data

    if not ray.is_initialized():
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
        ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    ray.data.DataContext.get_current().enable_progress_bars = False
