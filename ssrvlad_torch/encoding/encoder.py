"""Encoding: label maps, or images and a segmenter, -> descriptors, into a database or memory."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..database.database import Database, KnownFrames
from ..database.frames import FrameRecord, FrameSet
from ..datasets.frame_files import FrameFile
from ..datasets.label_files import LabelMap, digest, read_label_map
from ..datasets.remote_files import RemoteFile
from ..descriptor import SSRVLAD
from ..files import one_line
from ..segmentation.segmenter import Segmenter
from ..taxonomy import LabelSpace
from .interruption import deferred_interruption
from .workers import in_order

BATCH = 16
BATCHES_OF_A_CHUNK = 2
PART_ROWS = 4096

Progress = Callable[[int], None]
"""Called with the number of frames done since the last call."""


class Encoded(NamedTuple):
    """A frame and its ``(D,)`` float32 descriptor."""

    record: FrameRecord
    descriptor: Tensor


class Refusal(NamedTuple):
    """A frame that was not encoded, and why."""

    frame: str
    reason: str


class Unchanged(NamedTuple):
    """A frame whose file was written anew with the label map that it had."""

    frame: str


@dataclass
class Summary:
    """What an encoding run did.

    Attributes:
        encoded: number of frames that were added.
        changed: number of frames whose file had changed and whose row was replaced.
        already_there: number of frames that were left as they are.
        empty: number of frames, of those encoded or changed, with a descriptor of zeros.
        pruned: number of frames that were removed because their file is gone.
        gone: ids of frames that are there and whose file is gone.
        refused: frames that could not be encoded.
    """

    encoded: int = 0
    changed: int = 0
    already_there: int = 0
    empty: int = 0
    pruned: int = 0
    gone: list[str] = field(default_factory=list)
    refused: list[Refusal] = field(default_factory=list)


def encode_to_database(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    workers: int = 2,
    progress: Progress | None = None,
    segmenter: Segmenter | None = None,
    complete: bool = False,
    prune: bool = False,
    refuse: Callable[[Refusal], None] | None = None,
) -> Summary:
    """Encodes the frames that a database lacks, or whose file or pose has changed.

    A file has changed if its size or a time of it has, and then the label map that it holds. A
    frame that cannot be read or encoded is refused and the run goes on. New frames land in parts
    of `PART_ROWS`; on an exception those that wait for their part to fill are written before it
    goes on its way. SIGINT and SIGTERM wait until the frame in hand is done; a second one does
    not. No one else can write to the database meanwhile.

    Args:
        head: its settings must have the database's fingerprint.
        files: from `find_label_files`; with a segmenter, from `find_image_files`.
        database: where the raw descriptors go.
        workers: processes; see `encode`.
        progress: told of every frame that is done.
        segmenter: makes the label maps, of the head's label space; without, they are read. A frame
            whose image has not changed is not segmented again, whatever the segmenter.
        complete: the files are all that there are of their sequences, so that other frames of
            these are known to be gone.
        prune: with ``complete``, remove those that are gone.
        refuse: told of every refusal at once.

    Raises:
        ValueError: the fingerprints differ, the segmenter does not fit, ``prune`` without
            ``complete``, or another process writes to the database.
        OSError: the database cannot be written, or a worker was killed.
    """
    database.require(head.config)
    if prune and not complete:
        raise ValueError("prune wants to know all files of a sequence: complete")
    tell = progress or _tell_nobody
    origin = database.add_origin(head.label_space, segmenter.key() if segmenter else "")
    with deferred_interruption() as check:
        known = database.known()
        fresh, digests = _to_do(files, known, origin)
        summary = Summary(already_there=len(files) - len(fresh))
        if complete:
            summary.gone = _gone(files, known)
        tell(summary.already_there)
        results = _encode(head, fresh, digests, workers, segmenter)
        with _Writer(database, summary, known, origin) as writer:
            for result in results:
                if isinstance(result, Refusal):
                    summary.refused.append(result)
                    (refuse or _tell_nobody)(result)
                elif isinstance(result, Unchanged):
                    summary.already_there += 1
                else:
                    writer.add(result)
                tell(1)
                check()
        if prune:
            database.remove(summary.gone)
            summary.pruned, summary.gone = len(summary.gone), []
    return summary


def encode_to_memory(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    workers: int = 2,
    progress: Progress | None = None,
    segmenter: Segmenter | None = None,
) -> tuple[FrameSet, list[Refusal]]:
    """Encodes frames in order; arguments as for `encode_to_database`."""
    records: list[FrameRecord] = []
    refused: list[Refusal] = []
    descriptors = torch.zeros(len(files), head.config.length)
    tell = progress or _tell_nobody
    for frame in encode(head, files, workers, segmenter):
        if isinstance(frame, Refusal):
            refused.append(frame)
        else:
            descriptors[len(records)] = frame.descriptor
            records.append(frame.record)
        tell(1)
    descriptors = descriptors[: len(records)]
    frames = FrameSet(
        frames=tuple(record.frame for record in records),
        sequences=tuple(record.sequence for record in records),
        descriptors=descriptors,
        poses=np.array([(r.x, r.y, r.heading) for r in records], np.float64).reshape(-1, 3),
        stamps=np.array([record.stamp for record in records], np.float64),
        empty=~descriptors.any(dim=1).numpy(),
    )
    return frames, refused


def encode(
    head: SSRVLAD, files: Sequence[FrameFile], workers: int, segmenter: Segmenter | None = None
) -> Iterator[Encoded | Refusal]:
    """Encodes frames in order, in batches of frames of like size.

    Each worker reads and encodes some batches at a time, so that reading and encoding, and
    whatever is done with the results here, overlap. Where the head lies on another device than
    the CPU, the workers read and the head encodes here. A segmenter runs here, while the workers
    encode what it gave before. A few frames are not worth a worker.

    Args:
        head: the method. Workers run it as it is, but not what `SSRVLAD.compile` made of it:
            with one worker, that too.
        files: from `find_label_files`; with a segmenter, from `find_image_files`.
        workers: number of processes; with 0 or 1 all is done here.
        segmenter: makes the label maps; without, they are read.

    Raises:
        ValueError: the segmenter does not fit.
        ChildProcessError: a worker was killed.
    """
    for result in _encode(head, files, {}, workers, segmenter):
        if not isinstance(result, Unchanged):
            yield result


def stamp(file: FrameFile) -> int:
    """A number that changes whenever a file does: of its size and the times of its last changes.

    Returns:
        An int64, 0 if there is no such file.
    """
    if isinstance(file, RemoteFile):
        return file.stamp
    try:
        status = file.path.stat()
    except (OSError, ValueError):
        return 0
    text = f"{status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big", signed=True) or 1


def read_only(head: SSRVLAD, files: Sequence[FrameFile]) -> list[Item]:
    """The first half of `encode`: label maps and their digests, in memory."""
    return _read(head.label_space, [Item(file, "") for file in files])


def describe_only(head: SSRVLAD, items: Sequence[Item]) -> list[_Result]:
    """The second half of `encode`, of what `read_only` read."""
    return _describe(head, items)


class Item(NamedTuple):
    """A frame on its way: its file, the digest that is known of it, and what was read."""

    file: FrameFile
    known: str
    stamp: int = 0
    labels: LabelMap | ValueError | None = None
    digest: str = ""


class _Described(NamedTuple):
    """`Encoded` as a worker sends it: a tensor would take a file handle each."""

    record: FrameRecord
    descriptor: npt.NDArray[np.float32]


_Result = _Described | Refusal | Unchanged


class _Writer:
    """Puts frames into a database, a part at a time; what waits at the end too."""

    def __init__(
        self, database: Database, summary: Summary, known: KnownFrames, origin: str
    ) -> None:
        self._database = database
        self._origin = origin
        self._summary = summary
        self._known = known
        self._fresh: list[Encoded] = []
        self._changed: list[Encoded] = []

    def __enter__(self) -> _Writer:
        return self

    def __exit__(self, *_exception: object) -> None:
        with ExitStack() as both:
            both.callback(self._write_changed)
            both.callback(self._write_fresh)

    def add(self, frame: Encoded) -> None:
        frame = frame._replace(record=frame.record._replace(origin=self._origin))
        if frame.record.frame in self._known:
            self._changed.append(frame)
        else:
            self._fresh.append(frame)
        if len(self._fresh) == PART_ROWS:
            self._write_fresh()
        if len(self._changed) == PART_ROWS:
            self._write_changed()

    def _write_fresh(self) -> None:
        if self._fresh:
            self._summary.empty += _write(self._database.append, self._fresh)
            self._summary.encoded += len(self._fresh)
            self._fresh = []

    def _write_changed(self) -> None:
        if self._changed:
            self._summary.empty += _write(self._database.replace, self._changed)
            self._summary.changed += len(self._changed)
            self._changed = []


def _write(put: Callable[[Sequence[FrameRecord], Tensor], None], frames: Sequence[Encoded]) -> int:
    """Writes frames; the number of empty ones."""
    descriptors = torch.stack([frame.descriptor for frame in frames])
    put([frame.record for frame in frames], descriptors)
    return int((~descriptors.any(dim=1)).sum())


def _to_do(
    files: Sequence[FrameFile], known: KnownFrames, origin: str
) -> tuple[list[FrameFile], dict[str, str]]:
    """Files of frames that are new or may have changed; of the latter, digests of what is there.

    A frame whose pose has changed has no digest here: it must be written, whatever it holds.
    """
    fresh, digests = [], {}
    for file in files:
        there = known.get(file.frame)
        if there is not None and there.origin == origin:
            moved = not np.isnan(file.pose[0]) and not np.array_equal(
                file.pose, (there.x, there.y, there.heading), equal_nan=True
            )
            if not moved and there.signature == str(stamp(file)):
                continue
            if not moved:
                digests[file.frame] = there.digest
        fresh.append(file)
    return fresh, digests


def _gone(files: Iterable[FrameFile], known: KnownFrames) -> list[str]:
    there = {file.frame for file in files}
    sequences = {file.sequence for file in files}
    return [
        frame for frame in known if frame not in there and frame.rpartition("/")[0] in sequences
    ]


def _encode(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    digests: Mapping[str, str],
    workers: int,
    segmenter: Segmenter | None,
) -> Iterator[Encoded | Refusal | Unchanged]:
    """`encode`, but for frames that still have a digest that was given."""
    items = _items(head, files, digests, workers, segmenter)
    size = BATCHES_OF_A_CHUNK * BATCH
    chunks = iter(lambda: list(islice(items, size)), [])
    workers = workers if len(files) > size else 0
    read, describe = partial(_read, head.label_space), partial(_describe, head)
    if next(head.buffers()).device.type == "cpu":
        described = in_order(lambda chunk: describe(read(chunk)), chunks, workers)
    else:
        described = map(describe, in_order(read, chunks, workers))
    for result in chain.from_iterable(described):
        if isinstance(result, _Described):
            yield Encoded(result.record, torch.from_numpy(result.descriptor))
        else:
            yield result


def _items(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    digests: Mapping[str, str],
    workers: int,
    segmenter: Segmenter | None,
) -> Iterator[Item]:
    """The frames; those of a segmenter with their label maps."""
    if segmenter is None:
        return (Item(file, digests.get(file.frame, "")) for file in files)
    if segmenter.label_space != head.label_space:
        raise ValueError(
            f"the segmenter gives labels of {segmenter.label_space.name}, the head reads "
            f"{head.label_space.name}"
        )
    return _segmented(files, digests, workers, segmenter)


def _segmented(
    files: Sequence[FrameFile], digests: Mapping[str, str], workers: int, segmenter: Segmenter
) -> Iterator[Item]:
    """Frames with label maps. Stamps are taken before any file is read."""
    stamps = [stamp(file) for file in files]
    for (file, labels), time in zip(segmenter.label_maps(files, workers), stamps, strict=True):
        yield Item(file, digests.get(file.frame, ""), time, labels)


def _read(space: LabelSpace, chunk: Sequence[Item]) -> list[Item]:
    return [_read_one(space, item) for item in chunk]


def _read_one(space: LabelSpace, item: Item) -> Item:
    if item.labels is None:
        item = item._replace(stamp=stamp(item.file))
        try:
            item = item._replace(labels=_labels(item.file, space))
        except ValueError as error:
            item = item._replace(labels=error)
    if isinstance(item.labels, np.ndarray):
        item = item._replace(digest=digest(item.labels))
    return item


def _labels(file: FrameFile, space: LabelSpace) -> LabelMap:
    if not isinstance(file, RemoteFile):
        return read_label_map(file, space)
    try:
        with file.fetched() as local:
            return read_label_map(local, space)
    except OSError as error:
        raise ValueError(one_line(error)) from error


def _place(file: FrameFile) -> str:
    return file.uri if isinstance(file, RemoteFile) else str(file.path)


def _describe(head: SSRVLAD, chunk: Sequence[Item]) -> list[_Result]:
    """Describes frames, those of like size and dtype together."""
    results: dict[int, _Result] = {}
    alike: dict[object, list[int]] = {}
    for place, item in enumerate(chunk):
        frame, labels = item.file.frame, item.labels
        if not isinstance(labels, np.ndarray):
            results[place] = Refusal(frame, f"{_place(item.file)}: {labels}")
        elif item.digest == item.known:
            results[place] = Unchanged(frame)
        else:
            alike.setdefault((labels.shape, labels.dtype), []).append(place)
    for members in alike.values():
        for first in range(0, len(members), BATCH):
            places = members[first : first + BATCH]
            batch = _describe_batch(head, [chunk[place] for place in places])
            results.update(zip(places, batch, strict=True))
    return [results[place] for place in range(len(chunk))]


def _describe_batch(head: SSRVLAD, batch: Sequence[Item]) -> list[_Result]:
    """Describes frames of one size and dtype; if the batch is refused, one by one."""
    device = next(head.buffers()).device
    try:
        stack = torch.from_numpy(np.stack([np.asarray(item.labels) for item in batch]))
        descriptors = head(stack.to(device)).cpu().numpy()
    except ValueError as error:
        if len(batch) == 1:
            file = batch[0].file
            return [Refusal(file.frame, f"{_place(file)}: {error}")]
        return [result for item in batch for result in _describe_batch(head, [item])]
    records = [_record(item) for item in batch]
    return [_Described(*pair) for pair in zip(records, descriptors, strict=True)]


def _record(item: Item) -> FrameRecord:
    file, (height, width) = item.file, np.asarray(item.labels).shape
    record = FrameRecord(file.sequence, file.name, *file.pose)
    return record._replace(
        signature=str(item.stamp), digest=item.digest, height=height, width=width
    )


def _tell_nobody(_what: object) -> None:
    pass
