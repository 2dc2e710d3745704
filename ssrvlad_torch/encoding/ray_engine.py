"""Encoding by Ray Data, on this machine or on all of a cluster. It needs the extra ``ray``."""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..database.database import Database, Written
from ..datasets.frame_file import FrameFile
from ..datasets.names import absolute, is_uri
from ..descriptor import SSRVLAD
from ..files import one_line
from .describer import Described, Describer, Item
from .encoder import encoded
from .interruption import deferred_interruption
from .plan import NEW, Plan
from .results import EncodeOptions, Skipped, Summary, cores
from .writer import Writer

PART = 1024
"""Frames that are encoded and written together."""

_Batch = dict[str, Any]


class Part(NamedTuple):
    """The results of some frames.

    Attributes:
        results: of all but the written ones.
        written: new frames, in files of the database that are not committed.
        empty: how many written frames are empty.
    """

    results: list[Described | Skipped]
    written: Written | None = None
    empty: int = 0


def encode_with_ray(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
) -> Summary:
    """Encodes frames as `encode_to_database` does, by Ray.

    Every node of the cluster must find the files and the database. Actors encode new frames and
    write them as files of the database, which are committed here from time to time, and at the end
    or when the run is interrupted. If an actor is lost, another does its work again. Frames that
    replace others are sent here and committed here.

    Args:
        head: its settings must have the database's fingerprint.
        files: from `find_label_files`.
        database: gets the raw descriptors.
        options: how; ``workers`` are actors, one core each.

    Raises:
        ValueError: as for `encode_to_database`.
        ImportError: the extra ``ray`` is not installed.
        OSError: the database cannot be written, or Ray gave up.
    """
    _need_ray()
    options = options or EncodeOptions()
    database.require(head.config)
    if database.beside:
        raise ValueError(f"{database.path} holds descriptors of pictures; Ray reads label maps")
    with deferred_interruption() as check:
        origin = database.add_origin(head.label_space)
        plan = Plan.of(files, database, database.origins[origin])
        options.progress(plan.already_there)
        place = database.path if is_uri(database.path) else absolute(Path(database.path))
        encoder = PartEncoder(Describer(head, origin), place)
        with Writer(database, plan, options) as writer:
            for part in _parts(encoder, plan, options.workers or cores()):
                if part.written:
                    writer.add_written(part.written, part.empty)
                for result in part.results:
                    writer.add(encoded(result))
                check()
        return writer.finish()


class PartEncoder:
    """Encodes the files of a part, and writes the new ones to a database that every node finds."""

    def __init__(self, describer: Describer, database: str) -> None:
        self.describer = describer
        self.database = database

    def __call__(self, files: Sequence[FrameFile], new: bool) -> Part:
        """The results of the files of a part, whose frames are all new or all not."""
        results = self.describer([Item(file) for file in files])
        described = [result for result in results if isinstance(result, Described)]
        if not new or not described:
            return Part(results)
        descriptors = np.stack([result.descriptor for result in described])
        records = [result.record for result in described]
        written = Database.open(self.database).write_apart(records, descriptors)
        skipped = [result for result in results if isinstance(result, Skipped)]
        return Part([*skipped], written, int((~descriptors.any(axis=1)).sum()))


class Actor:
    """What `map_batches` makes an actor of: pickled files in, a pickled `Part` or an error out."""

    def __init__(self, encoder: PartEncoder) -> None:
        torch.set_num_threads(1)
        self.encode = encoder

    def __call__(self, batch: _Batch) -> _Batch:
        """A batch of one part."""
        [files], [new] = batch["files"], batch["new"]
        try:
            part: Part | OSError = self.encode(pickle.loads(files), bool(new))
        except OSError as error:  # of the disk: trying again does not help
            part = OSError(one_line(error))
        except Exception as error:  # Ray would report itself, and not this
            part = OSError(f"Ray gave up: {one_line(error)}")
        return {"part": [pickle.dumps(part)]}


def _parts(encoder: PartEncoder, plan: Plan, workers: int) -> Iterator[Part]:
    """The results of Ray for the files of a plan, as they arrive."""
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
        raise OSError(f"Ray gave up: {one_line(cause)}") from error


def _need_ray() -> None:
    try:
        import ray.data  # noqa: F401
    except ImportError as error:
        raise ImportError("--engine ray needs: pip install ssrvlad-torch[ray]") from error


def _quiet_ray() -> None:
    """Connects to Ray, if nobody has, without its logs."""
    import ray.data

    if not ray.is_initialized():
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
        ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    ray.data.DataContext.get_current().enable_progress_bars = False
