"""Encoding: label maps, or images with a segmenter -> descriptors in a database or in memory."""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels import LABEL_SHAPES
from ..channels.channel import (
    FEATURES,
    PICTURE,
    Channel,
    Network,
    View,
    channel_of,
    channels_of,
    new_channels,
    refuse_text,
)
from ..database.database import Database
from ..database.frames import FrameRecord, FrameSet
from ..database.rows import Origin
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import read_image
from ..datasets.label_files import LabelMap, digest, read_label_map
from ..datasets.reading import in_order
from ..descriptor import SSRVLAD
from ..segmentation.cache import remember
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .plan import Plan, Writer
from .results import (
    Encoded,
    EncodeOptions,
    Note,
    Progress,
    Skipped,
    Summary,
    do_nothing,
)
from .source import cache_folder

AHEAD = 3
"""Batches in memory for each worker."""
BATCH = 16
"""Frames of one size in a batch; a larger batch does not fit in the processor's cache."""


def encode_to_database(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    options: EncodeOptions | None = None,
    segmenter: Segmenter | None = None,
) -> Summary:
    """Encodes the frames that a database lacks and those whose row is out of date, see `Plan`, by
    all channels of which it has a column. Files are label maps, or with a segmenter images; one
    that cannot be read or encoded is skipped. Frames are committed every few seconds, and before an
    exception is raised. Settings, a segmenter or a folder that do not fit the database are a
    ValueError, one that cannot be written is an OSError."""
    options = options or EncodeOptions()
    plan, describer = prepared(head, files, database, options, segmenter)
    results = encode(describer, plan.files, options.workers, segmenter)
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
    plan = Plan.of(files, database, Origin(head.label_space, *network))  # it may refuse
    origin = database.add_origin(head.label_space, *network)
    if segmenter and segmenter.state:
        remember(segmenter.name, segmenter.state, segmenter.key(), cache_folder())
    options.progress(plan.already_there)
    return plan, Describer(channels, head.label_space, origin=origin)


def method_for(
    database: Database | None,
    preset: str | None,
    labels_as: str | LabelSpace,
    network: Network | None,
    names: Sequence[str] | None,
    note: Note = do_nothing,
) -> tuple[SSRVLAD, list[Channel]]:
    """How frames of a label space are described that are added to a database, or to a new one: the
    head, of a preset, or else of the database, or ``default``; and the channels beside it, those
    that the user names. Without names, a new database gets all that the frames have, with a note if
    the network has no features; an existing one gets no other. Names of channels of pictures
    without a network are a ValueError."""
    if database and preset is None:
        head = SSRVLAD(replace(database.config, labels_as=labels_as))
    else:
        head = SSRVLAD.from_preset(preset or "default", labels_as=labels_as)
    refuse_text(names)
    if names is None and network is None:
        return head, []
    if names is None and database:
        of_pictures = any(origin.segmenter for origin in database.used_origins())
        if len(database.columns) == 1 and not of_pictures:
            note(f"{database.path} is of label maps alone: features and HOG are not stored")
        return head, []
    if names is None and network and (problem := network.problem_of_features):
        note(f"stored without features: {problem}")
    if network is None and (beside := [name for name in names or () if name != LABEL_SHAPES]):
        raise ValueError(f"--channel {beside[0]} needs images as SOURCE and --segmenter")
    return head, new_channels(names, head, network)[1:]


def check_segmenter(
    segmenter: Segmenter | None, head: SSRVLAD, channels: Sequence[Channel]
) -> None:
    """Raises a ValueError unless a segmenter has the label space of a head, and views of it have
    these channels."""
    for channel in channels:
        current = channel_of(type(channel), head, segmenter)
        if current.column != channel.column:
            raise ValueError(
                f"stored descriptors by {channel.name} are of {channel.fingerprint}, got "
                f"{current.fingerprint}: encode again, with the file that will be deployed, or use "
                "what made them; a module, its ONNX file and another size are different networks"
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
    """The frames of a label space that could be encoded and those that were skipped, in order, see
    `encode`. ``columns`` are the anchors of channels that can sweep, see `Channel.describe`;
    ``progress`` is called with 1 for each frame."""
    encoded, skipped = list[FrameFile](), list[Skipped]()
    described = defaultdict[str, list[npt.NDArray[Any]]](list)
    results = encode(Describer(channels, space, columns), files, workers, segmenter)
    for file, result in zip(files, results, strict=True):
        if isinstance(result, Skipped):
            skipped.append(result)
        else:
            encoded.append(file)
            for name, descriptor in result.descriptors.items():
                described[name].append(descriptor)
        progress(1)
    descriptors = dict[str, Tensor]()
    for channel in channels:
        rows, none = described[channel.name], np.zeros((0, *channel.shape), channel.dtype)
        descriptors[channel.name] = torch.from_numpy(np.stack(rows) if rows else none)
    first = described[channels[0].name]
    return FrameSet(
        frames=tuple(file.frame for file in encoded),
        sequences=tuple(file.sequence for file in encoded),
        channels=descriptors,
        poses=np.array([file.pose for file in encoded], np.float64).reshape(-1, 3),
        stamps=np.array([file.stamp for file in encoded], np.float64),
        empty=np.array([not descriptor.any() for descriptor in first], np.bool_),
    ), skipped


def cores() -> int:
    """Number of cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def encode(
    describer: Describer,
    files: Sequence[FrameFile],
    workers: int | None = None,
    segmenter: Segmenter | None = None,
) -> Generator[Encoded | Skipped]:
    """Encodes label maps, or images with a segmenter, in order. Each worker, by default one for
    each core, is a thread that reads and describes one batch at a time; with 0 or 1 everything runs
    in the caller's thread. Where a channel describes there alone, workers only read. A segmenter
    runs there too, while workers describe its earlier label maps."""
    workers = cores() if workers is None else workers
    items: Iterator[Item] = map(Item, files)
    if segmenter:
        items = segmented_items(files, segmenter, workers, describer.needs(FEATURES))
    batches = iter(lambda: list(islice(items, BATCH)), [])
    limits = [channel.threads for channel in describer.channels if channel.threads is not None]
    reads_only = 0 in limits
    if not reads_only:
        workers = min([workers, *limits])
    work: Callable[[list[Item]], Any] = partial(read, describer.space) if reads_only else describer
    threads = torch.get_num_threads()
    results: Iterator[Any] = map(work, batches)
    if workers > 1:
        one_thread = partial(torch.set_num_threads, 1)
        results = in_order(work, batches, workers, AHEAD * workers, one_thread)
    try:
        for batch in results:
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
    for (file, result), signature in zip(results, signatures, strict=True):
        if isinstance(result, ValueError):
            yield Item(file, signature, result)
        else:
            yield Item(file, signature, *result)


class Item(NamedTuple):
    """A frame to describe: its file, the file's signature before reading, its label map, and its
    features if the database stores them."""

    file: FrameFile
    signature: str = ""
    labels: LabelMap | ValueError | None = None
    features: npt.NDArray[np.uint8] | None = None
    digest: str = ""


def read(space: LabelSpace, items: Sequence[Item]) -> list[Item]:
    """Items with label maps and their digests; those without a label map are read."""

    def read_one(item: Item) -> Item:
        signature, labels = item.signature, item.labels
        if labels is None:
            signature = item.file.signature()
            try:
                labels = read_label_map(item.file, space)
            except ValueError as error:
                labels = error
        key = item.digest or (digest(labels) if isinstance(labels, np.ndarray) else "")
        return item._replace(signature=signature, labels=labels, digest=key)

    readers = max((item.file.readers for item in items if not item.digest), default=1)
    if readers == 1:
        return list(map(read_one, items))
    return list(in_order(read_one, items, readers, readers))


@dataclass(frozen=True)
class Describer:
    """Items of a label space -> descriptors by some channels, from anchors, the ``columns``, if
    any, with an origin for their records, see `Database.add_origin`. It can be pickled."""

    channels: Sequence[Channel]
    space: LabelSpace
    columns: Sequence[int] = ()
    origin: str = ""

    def needs(self, what: str) -> bool:
        """Whether a channel needs labels, the picture or features of a view."""
        return any(what in channel.needs for channel in self.channels)

    def __call__(self, items: Sequence[Item]) -> list[Encoded | Skipped]:
        """The results of frames, in their order; a batch has one size and dtype."""
        items = read(self.space, items)
        results: dict[int, Encoded | Skipped] = {}
        groups: dict[object, list[int]] = {}
        for row, item in enumerate(items):
            if isinstance(item.labels, np.ndarray):
                groups.setdefault((item.labels.shape, item.labels.dtype), []).append(row)
            else:
                results[row] = _skipped(item, item.labels)
        for group in groups.values():
            for first in range(0, len(group), BATCH):
                rows = group[first : first + BATCH]
                batch = self._results([items[row] for row in rows])
                results.update(zip(rows, batch, strict=True))
        return [results[row] for row in range(len(items))]

    def _results(self, batch: Sequence[Item]) -> list[Encoded | Skipped]:
        """The results of frames of one size, which are described one by one if they fail."""
        views, pictured = list[View](), self.needs(PICTURE)
        try:
            for item in batch:
                picture = read_image(item.file) if pictured else None
                labels = np.asarray(item.labels)
                views.append(View(item.file.frame, labels, self.space, picture, item.features))
            described = {c.name: c.describe(views, self.columns).numpy() for c in self.channels}
        except ValueError as error:
            if len(batch) == 1:
                return [_skipped(batch[0], error)]
            return [result for item in batch for result in self._results([item])]
        encoded = list[Encoded | Skipped]()
        for row, (item, view) in enumerate(zip(batch, views, strict=True)):
            file, (height, width) = item.file, np.asarray(view.labels).shape
            record = FrameRecord(
                file.sequence, file.name, *file.pose, file.stamp, item.signature, item.digest,
                height, width, self.origin,
            )  # fmt: skip
            encoded.append(Encoded(record, {n: values[row] for n, values in described.items()}))
        return encoded


def _skipped(item: Item, reason: object) -> Skipped:
    return Skipped(item.file.frame, f"{item.file.location}: {reason}")
