"""Encoding: label maps, or images with a segmenter -> descriptors in a database or in memory."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch

from ..channels import LABEL_SHAPES
from ..channels.channel import FEATURES, Channel, Network, channels_of, new_channels
from ..database.database import Database
from ..database.frames import FrameSet
from ..datasets.frame_files import FrameFile
from ..datasets.workers import in_order
from ..descriptor import SSRVLAD
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .describer import BATCH, Describer, Item, read
from .plan import Plan
from .results import (
    Encoded,
    EncodeOptions,
    Note,
    Progress,
    Skipped,
    Summary,
    cores,
    do_nothing,
    stacked,
)
from .writer import Writer

AHEAD = 3
"""Batches in memory for each worker."""


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
        database: receives the raw descriptors by all channels of which it has a column.
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
    channels = channels_of(database.columns, head)
    check_segmenter(segmenter, head, channels)
    network = (segmenter.key(), segmenter.name) if segmenter else ()
    origin = database.add_origin(head.label_space, *network)
    plan = Plan.of(files, database, database.origins[origin])
    options.progress(plan.already_there)
    return plan, Describer(channels, head.label_space, origin=origin)


def channels_to_store(
    database: Database | None,
    head: SSRVLAD,
    network: Network | None,
    names: Sequence[str] | None,
    note: Note = do_nothing,
) -> list[Channel]:
    """The channels that are stored beside that of label maps: those that the user names. Without
    names, a new database gets all that the frames have, with a note if the network has no features;
    an existing one gets no other. Names of channels of pictures without a network are a
    ValueError."""
    if names is None and network is None:
        return []
    if names is None and database:
        of_pictures = any(origin.segmenter for origin in database.origins.values())
        if len(database.columns) == 1 and not of_pictures:
            note(f"{database.path} is of label maps alone: features and HOG are not stored")
        return []
    if names and network is None and (beside := [n for n in names if n != LABEL_SHAPES]):
        raise ValueError(f"--channel {beside[0]} needs images as SOURCE and --segmenter")
    if names is None and network and (problem := network.problem_of_features):
        note(f"stored without features: {problem}")
    return new_channels(names, head, network)[1:]


def check_segmenter(
    segmenter: Segmenter | None, head: SSRVLAD, channels: Sequence[Channel]
) -> None:
    """Raises a ValueError unless a segmenter has the label space of a head, and views of it have
    these channels."""
    for channel in channels:
        (current,) = new_channels([channel.column.name], head, segmenter)[-1:]
        if current.column != channel.column:
            raise ValueError(
                f"stored descriptors by {channel.column.name} are of {channel.column.fingerprint}, "
                f"got {current.column.fingerprint}: encode again, with the file that will be "
                "deployed, or use what made them; a module, its ONNX file and another size are "
                "different networks"
            )
    if segmenter and segmenter.label_space != head.label_space:
        raise ValueError(
            f"the segmenter gives labels of {segmenter.label_space.name}, the head reads "
            f"{head.label_space.name}"
        )


def encode_to_memory(
    channels: Sequence[Channel],
    space: LabelSpace,
    files: Sequence[FrameFile],
    workers: int | None = None,
    progress: Progress = do_nothing,
    segmenter: Segmenter | None = None,
    columns: Sequence[int] = (),
) -> tuple[FrameSet, list[Skipped]]:
    """The frames that could be encoded and those that were skipped, in order. ``progress`` is
    called with 1 for each frame; other arguments and errors as for `encode`."""
    frames: list[Encoded] = []
    skipped: list[Skipped] = []
    for frame in encode(channels, space, files, workers, segmenter, columns):
        if isinstance(frame, Skipped):
            skipped.append(frame)
        else:
            frames.append(frame)
        progress(1)
    records = [frame.record for frame in frames]
    stored = [channel.column for channel in channels]
    nothing = {column.name: np.zeros((0, *column.shape), column.dtype) for column in stored}
    descriptors = stacked(frames) if frames else nothing
    return FrameSet(
        frames=tuple(record.frame for record in records),
        sequences=tuple(record.sequence for record in records),
        channels={name: torch.from_numpy(values) for name, values in descriptors.items()},
        poses=np.array([record[2:5] for record in records], np.float64).reshape(-1, 3),
        stamps=np.array([record.stamp for record in records], np.float64),
        empty=np.array([frame.is_empty for frame in frames], np.bool_),
    ), skipped


def encode(
    channels: Sequence[Channel],
    space: LabelSpace,
    files: Sequence[FrameFile],
    workers: int | None = None,
    segmenter: Segmenter | None = None,
    columns: Sequence[int] = (),
) -> Iterator[Encoded | Skipped]:
    """Encodes label maps of a label space, or images with a segmenter, in order, by some channels.

    ``columns`` are the anchors of channels that can sweep, see `Channel.describe`. Each worker, by
    default one for each core, is a thread that reads and describes one batch at a time; with 0 or 1
    everything runs in the caller's thread. Where a channel describes in the caller's thread alone,
    workers only read. A segmenter runs there too, while workers describe its earlier
    label maps.
    """
    return _encode(Describer(channels, space, columns), files, workers, segmenter)


def _encode(
    describer: Describer,
    files: Sequence[FrameFile],
    workers: int | None,
    segmenter: Segmenter | None,
) -> Generator[Encoded | Skipped]:
    workers = cores() if workers is None else workers
    items: Iterator[Item] = map(Item, files)
    if segmenter:
        items = segmented_items(files, segmenter, workers, describer.needs(FEATURES))
    batches = iter(lambda: list(islice(items, BATCH)), [])
    limits = [channel.threads for channel in describer.channels if channel.threads is not None]
    reads_only = 0 in limits
    if not reads_only:
        workers = min([workers, *limits])
    work: Callable[[list[Item]], Any] = describer
    if reads_only:
        work = partial(read, describer.space)
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
    """Frames with the label maps, and if asked for the features, of the network; signatures are
    taken before any file is read."""
    signatures = [file.signature() for file in files]
    results = segmenter.segmented(files, workers, features)
    for (file, said), signature in zip(results, signatures, strict=True):
        if isinstance(said, ValueError):
            yield Item(file, signature, said)
        else:
            yield Item(file, signature, *said)
