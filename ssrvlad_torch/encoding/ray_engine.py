"""Encoding with Ray Data, on this machine or on a cluster; needs the extra ``ray``."""

import logging
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch

from ..channels.channel import FEATURES
from ..database.database import Database
from ..datasets.frame_file import FrameFile
from ..descriptor import SSRVLAD
from ..files import one_line, requiring
from ..segmentation.segmenter import Segmenter
from .encoder import Describer, Item, cores, prepared, segmented_items
from .plan import Plan, Writer
from .results import Encoded, EncodeOptions, Skipped, Summary

CHUNK_FRAMES = 1024
"""Number of frames that are encoded and written together."""

CHUNK_PICTURES = 32
"""The same where a network labels the frames: about ten seconds of work."""

_Batch = dict[str, Any]


def encode_with_ray(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
    segmenter: Segmenter | None = None,
) -> Summary:
    """Encodes frames with Ray; arguments, result and errors are those of `encode_to_database`.

    Every node of the cluster must be able to open the files, and the network by its name. A worker
    is an actor with one core and ``gpus``, which loads the network once; if it is lost, another
    repeats its work. The caller's process writes the database. Too few GPUs are a ValueError, an
    error of Ray is an OSError, and its extra missing an ImportError."""
    with requiring("ray", "--engine ray needs"):
        import ray.data  # noqa: F401
    options = options or EncodeOptions()
    plan, describer = prepared(head, files, database, options, segmenter)
    encoder = ChunkEncoder(describer, segmenter, options.gpus)
    with Writer(database, plan, options) as writer:
        for result in _results(encoder, plan, options):
            writer.add(result)
    return writer.summary


class ChunkEncoder:
    """Encodes the files of a chunk. An actor loads a segmenter that has a name by it; another one
    is sent with its weights."""

    def __init__(self, describer: Describer, segmenter: Segmenter | None, gpus: float) -> None:
        self.describer, self.gpus = describer, gpus
        self.load: Callable[[], Segmenter] | None = None
        self._segmenter: Segmenter | None = None
        if segmenter:
            how = segmenter.name, segmenter.label_space, segmenter.cache
            by_name = partial(Segmenter.load, *how)
            self.load = by_name if segmenter.name else lambda: segmenter
            self._key = segmenter.key()

    def __call__(self, files: Sequence[FrameFile]) -> list[Encoded | Skipped]:
        """The results of the files of a chunk."""
        if self.load is None:
            return self.describer([*map(Item, files)])
        if self._segmenter is None:
            segmenter = self.load()
            if self.gpus:
                segmenter.network.to("cuda")
            if segmenter.key() != self._key:
                name = segmenter.name
                raise ValueError(f"{name} is another network here than where Ray was called")
            self._segmenter = segmenter
        features = self.describer.needs(FEATURES)
        return self.describer([*segmented_items(files, self._segmenter, 1, features)])


class Actor:
    """An actor for `map_batches`: takes pickled files, returns pickled results or an error."""

    def __init__(self, encoder: bytes) -> None:
        torch.set_num_threads(1)
        self.encode: ChunkEncoder = pickle.loads(encoder)

    def __call__(self, batch: _Batch) -> _Batch:
        """The batch holds one chunk."""
        [files] = batch["files"]
        try:
            results: list[Encoded | Skipped] | OSError = self.encode(pickle.loads(files))
        except OSError as error:  # a disk error: Ray must not retry
            results = OSError(one_line(error))
        except Exception as error:  # the report of Ray would not show it
            results = OSError(f"Ray failed: {one_line(error)}")
        return {"results": [pickle.dumps(results)]}


def _results(
    encoder: ChunkEncoder, plan: Plan, options: EncodeOptions
) -> Iterator[Encoded | Skipped]:
    """The results for the files of a plan, as they arrive."""
    import ray.cloudpickle
    import ray.data

    length = CHUNK_PICTURES if encoder.load else CHUNK_FRAMES
    rows = [
        {"files": pickle.dumps(plan.files[first : first + length])}
        for first in range(0, len(plan.files), length)
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
            results = pickle.loads(row["results"])
            if isinstance(results, OSError):
                raise results
            yield from results
    except ray.exceptions.RayError as error:
        cause = error.cause if isinstance(error, ray.exceptions.RayTaskError) else error
        raise OSError(f"Ray failed: {one_line(cause)}") from error
