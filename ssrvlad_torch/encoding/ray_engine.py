"""Encoding with Ray Data, on this machine or on a cluster; needs the extra ``ray``."""

import logging
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ..channels.channel import FEATURES
from ..database.database import Database, StagedRows
from ..datasets.frame_file import FrameFile
from ..datasets.names import absolute
from ..descriptor import SSRVLAD
from ..files import is_uri, one_line, requiring
from ..segmentation.segmenter import Segmenter
from .encoder import Describer, Item, prepared, segmented_items
from .plan import NEW, Plan, Writer
from .results import Encoded, EncodeOptions, Skipped, Summary, cores, stacked

CHUNK_FRAMES = 1024
"""Number of frames that are encoded and written together."""

CHUNK_PICTURES = 32
"""The same where a network labels the frames: about ten seconds of work."""

_Batch = dict[str, Any]


class Chunk(NamedTuple):
    """The results of one chunk of the frames: new frames are staged, written to files of the
    database but not committed, ``empty`` of them empty; the others are in ``results``."""

    results: list[Encoded | Skipped]
    staged: StagedRows | None = None
    empty: int = 0


def encode_with_ray(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
    segmenter: Segmenter | None = None,
) -> Summary:
    """Encodes frames with Ray; arguments, result and errors are those of `encode_to_database`.

    Every node of the cluster must be able to open the files, the database, and the network by its
    name. A worker is an actor with one core and ``gpus``, which loads the network once and writes
    new frames to files of the database, which the caller's process commits. If an actor is lost,
    another repeats its work. Frames that replace others are written by the caller. Too few GPUs are
    a ValueError, an error of Ray is an OSError, and its extra missing an ImportError."""
    with requiring("ray", "--engine ray needs"):
        import ray.data  # noqa: F401
    options = options or EncodeOptions()
    plan, describer = prepared(head, files, database, options, segmenter)
    path = database.path if is_uri(database.path) else absolute(Path(database.path))
    encoder = ChunkEncoder(describer, path, segmenter, options.gpus)
    with Writer(database, plan, options) as writer:
        for chunk in _chunks(encoder, plan, options):
            if chunk.staged:
                writer.add_staged(chunk.staged, chunk.empty)
            for result in chunk.results:
                writer.add(result)
    return writer.summary


class ChunkEncoder:
    """Encodes the files of a chunk, and stages new frames in the database at a path. An actor loads
    a segmenter that has a name by it; another one is sent with its weights."""

    def __init__(
        self, describer: Describer, database: str, segmenter: Segmenter | None, gpus: float
    ) -> None:
        self.describer, self.database, self.gpus = describer, database, gpus
        self.load: Callable[[], Segmenter] | None = None
        self._segmenter: Segmenter | None = None
        if segmenter:
            how = segmenter.label_space, segmenter.cache, segmenter.config.classes
            by_name = partial(Segmenter.load, segmenter.name, *how)
            self.load = by_name if segmenter.name else lambda: segmenter
            self._key = segmenter.key()

    def __call__(self, files: Sequence[FrameFile], new: bool) -> Chunk:
        """The results of the files of a chunk; ``new``: none of its frames is in the database."""
        items = list(map(Item, files))
        if self.load:
            if self._segmenter is None:
                segmenter = self.load()
                if self.gpus:
                    segmenter.network.to("cuda")
                if segmenter.key() != self._key:
                    name = segmenter.name
                    raise ValueError(f"{name} is another network here than where Ray was called")
                self._segmenter = segmenter
            features = self.describer.needs(FEATURES)
            items = list(segmented_items(files, self._segmenter, 1, features))
        results = self.describer(items)
        described = [result for result in results if isinstance(result, Encoded)]
        if not new or not described:
            return Chunk(results)
        records = [result.record for result in described]
        staged = Database.open(self.database).write_apart(records, stacked(described))
        skipped = [result for result in results if isinstance(result, Skipped)]
        return Chunk([*skipped], staged, sum(result.is_empty for result in described))


class Actor:
    """An actor for `map_batches`: takes pickled files, returns a pickled `Chunk` or an error."""

    def __init__(self, encoder: bytes) -> None:
        torch.set_num_threads(1)
        self.encode: ChunkEncoder = pickle.loads(encoder)

    def __call__(self, batch: _Batch) -> _Batch:
        """The batch holds one chunk."""
        [files], [new] = batch["files"], batch["new"]
        try:
            chunk: Chunk | OSError = self.encode(pickle.loads(files), bool(new))
        except OSError as error:  # a disk error: Ray must not retry
            chunk = OSError(one_line(error))
        except Exception as error:  # the report of Ray would not show it
            chunk = OSError(f"Ray failed: {one_line(error)}")
        return {"chunk": [pickle.dumps(chunk)]}


def _chunks(encoder: ChunkEncoder, plan: Plan, options: EncodeOptions) -> Iterator[Chunk]:
    """The results for the files of a plan, as they arrive."""
    import ray.cloudpickle
    import ray.data

    length = CHUNK_PICTURES if encoder.load else CHUNK_FRAMES
    rows = [
        {"files": pickle.dumps(files[first : first + length]), "new": new}
        for new in (True, False)
        for files in [[file for file in plan.files if (plan.reasons[file.frame] == NEW) == new]]
        for first in range(0, len(files), length)
    ]
    if not rows:
        return
    if not ray.is_initialized():
        os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
        try:
            ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
        except Exception as error:  # Ray has no common error type for this
            raise OSError(f"Ray does not start: {one_line(error)}") from error
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    ray.data.DataContext.get_current().enable_progress_bars = False
    gpus = options.gpus if encoder.load else 0
    if gpus > (there := ray.cluster_resources().get("GPU", 0)):
        raise ValueError(f"the cluster has {there:g} GPUs, expected {gpus:g} for each worker")
    workers = max(1, min(options.workers or cores(), len(rows)))
    chunks = ray.data.from_items(rows, override_num_blocks=len(rows)).map_batches(
        Actor,
        fn_constructor_args=(ray.cloudpickle.dumps(encoder),),
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=workers),
        num_cpus=1,
        num_gpus=gpus or None,
    )
    try:
        for row in chunks.iter_rows():
            chunk = pickle.loads(row["chunk"])
            if isinstance(chunk, OSError):
                raise chunk
            yield chunk
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        raise OSError(f"Ray failed: {one_line(cause)}") from error
