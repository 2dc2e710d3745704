"""Encoding: label maps, or images with a segmenter -> descriptors in a database or in memory."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch

from ..database.database import Database
from ..database.frames import FrameSet
from ..database.metadata import ExtraDescriptor
from ..datasets.frame_files import FrameFile
from ..datasets.label_files import read_label_map
from ..datasets.workers import in_order
from ..descriptor import SSRVLAD
from ..segmentation.features import NAME as FEATURES
from ..segmentation.segmenter import Segmenter
from ..taxonomy import VOID
from .describer import BATCH, Describer, Item, read
from .extra_descriptors import check_segmenter
from .plan import Plan
from .results import Encoded, EncodeOptions, Progress, Skipped, Summary, cores, do_nothing
from .writer import Writer

AHEAD = 3
"""Batches in memory for each worker."""

MOST_TORCH_THREADS = 2
"""Threads of the torch path: its many short operators wait for Python's global lock, which the
native core and the decoders of images release."""


def encode_to_database(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
    segmenter: Segmenter | None = None,
) -> Summary:
    """Encodes the frames that a database lacks and those whose row is out of date; see `Plan`.

    A frame that cannot be read or encoded is skipped. Frames are committed every few seconds, and
    before an exception is raised.

    Args:
        head: its settings must have the database's fingerprint.
        files: from `find_label_files`; with a segmenter, from `find_image_files`.
        database: receives the raw descriptors and the extra descriptors that it stores.
        options: workers, pruning and callbacks.
        segmenter: makes label maps in the head's label space; without it, files are label maps.

    Raises:
        ValueError: the settings or the segmenter do not fit the database, see `Database.require`
            and `encode`, or a sequence of the database comes from another folder.
        OSError: the database cannot be written.

    Examples:
        >>> database = Database.create("town.ssrdb", head.config)
        >>> encode_to_database(head, find_label_files(["maps/monday"]), database).encoded
        1000
    """
    options = options or EncodeOptions()
    plan, describer = prepared(head, files, database, options, segmenter)
    results = _encode(describer, plan.files, options.workers, segmenter)
    with closing(results), Writer(database, plan, options) as writer:
        for result in results:
            writer.add(result)
    return writer.summary


def prepared(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions,
    segmenter: Segmenter | None,
) -> tuple[Plan, Describer]:
    """What to encode into a database, and how; arguments and errors as for `encode_to_database`."""
    database.require(head.config)
    check_segmenter(segmenter, head.label_space, database.extra)
    network = (segmenter.key(), segmenter.name) if segmenter else ()
    origin = database.add_origin(head.label_space, *network)
    plan = Plan.of(files, database, database.origins[origin])
    options.progress(plan.already_there)
    return plan, Describer(head, origin, database.extra)


def encode_to_memory(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    workers: int | None = None,
    progress: Progress = do_nothing,
    segmenter: Segmenter | None = None,
    extra: Sequence[ExtraDescriptor] = (),
) -> tuple[FrameSet, list[Skipped]]:
    """The frames that could be encoded and those that were skipped, in order. ``progress`` is
    called with 1 for each frame; other arguments and errors as for `encode`."""
    frames: list[Encoded] = []
    skipped: list[Skipped] = []
    for frame in encode(head, files, workers, segmenter, extra):
        if isinstance(frame, Skipped):
            skipped.append(frame)
        else:
            frames.append(frame)
        progress(1)
    records = [frame.record for frame in frames]
    descriptors = torch.zeros(0, head.config.length, dtype=torch.float32, device="cpu")
    if frames:
        descriptors = torch.from_numpy(np.stack([frame.descriptor for frame in frames]))
    names = [each.name for each in extra if frames]
    return FrameSet(
        frames=tuple(record.frame for record in records),
        sequences=tuple(record.sequence for record in records),
        descriptors=descriptors,
        poses=np.array([record[2:5] for record in records], np.float64).reshape(-1, 3),
        stamps=np.array([record.stamp for record in records], np.float64),
        empty=~descriptors.flatten(1).any(1).numpy(),
        extra={n: torch.from_numpy(np.stack([f.extra[n] for f in frames])) for n in names},
    ), skipped


def encode(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    workers: int | None = None,
    segmenter: Segmenter | None = None,
    extra: Sequence[ExtraDescriptor] = (),
) -> Iterator[Encoded | Skipped]:
    """Encodes label maps, or images with a segmenter, in order, with extra descriptors of the
    pictures. Extra descriptors without a segmenter, and a segmenter of another label space or
    with other descriptors, are a ValueError.

    Each worker, by default one for each core, is a thread that reads and describes one batch at a
    time; with 0 or 1 everything runs in the caller's thread. If the head is not on the CPU, workers
    only read, and the head runs in the caller's thread. A segmenter runs there too, while workers
    describe its earlier label maps.
    """
    check_segmenter(segmenter, head.label_space, extra)
    return _encode(Describer(head, extra=extra), files, workers, segmenter)


def _encode(
    describer: Describer,
    files: Sequence[FrameFile],
    workers: int | None,
    segmenter: Segmenter | None,
) -> Generator[Encoded | Skipped]:
    workers = cores() if workers is None else workers
    items: Iterator[Item] = map(Item, files)
    if segmenter:
        features = any(each.name == FEATURES for each in describer.extra)
        items = segmented_items(files, segmenter, workers, features)
    batches = iter(lambda: list(islice(items, BATCH)), [])
    reads_only = describer.device.type != "cpu"
    if not (reads_only or describer.head.native):
        workers = min(workers, MOST_TORCH_THREADS)
    work: Callable[[list[Item]], Any] = describer
    if reads_only:
        work = partial(read, describer.head.label_space)
    threads = torch.get_num_threads()
    done: Iterator[Any] = map(work, batches)
    if workers > 1:
        one = partial(torch.set_num_threads, 1)
        done = in_order(work, batches, workers, AHEAD * workers, one)
    try:
        for batch in done:
            yield from describer(batch) if reads_only else batch
    finally:
        torch.set_num_threads(threads)  # for later threads


def segmented_items(
    files: Sequence[FrameFile], segmenter: Segmenter, workers: int, features: bool
) -> Iterator[Item]:
    """Frames with what the network says of them; signatures are taken before any file is read."""
    signatures = [file.signature() for file in files]
    results = segmenter.segmented(files, workers, features)
    for (file, said), signature in zip(results, signatures, strict=True):
        if isinstance(said, ValueError):
            yield Item(file, signature, said)
        else:
            yield Item(file, signature, *said)


def before_the_first(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    segmenter: Segmenter | None = None,
    extra: Sequence[ExtraDescriptor] = (),
) -> tuple[list[Skipped], float]:
    """The skipped frames before the first that can be encoded, and the fraction of void pixels of
    its label map, 0 to 1; 0 for a picture. Arguments as for `encode`."""
    skipped: list[Skipped] = []
    for file in files:
        (result,) = encode(head, [file], 1, segmenter, extra)
        if isinstance(result, Skipped):
            skipped.append(result)
            continue
        if segmenter:
            break
        void = [label.id for label in head.label_space.classes if label.category == VOID]
        return skipped, float(np.isin(read_label_map(file, head.label_space), void).mean())
    return skipped, 0.0
