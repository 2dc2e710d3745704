"""Encoding: label maps, or images and a segmenter, -> descriptors, into a database or memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .database import Database, FrameRecord, FrameSet
from .datasets.frame_files import FrameFile, read_ahead
from .datasets.label_files import LabelMap, digest, read_label_map
from .descriptor import SSRVLAD
from .segmentation import Segmenter

BATCH = 16
PART_ROWS = 4096
_READ_AHEAD = 4 * BATCH

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


@dataclass
class Summary:
    """What an encoding run did: numbers of frames, and the refused ones."""

    encoded: int = 0
    already_there: int = 0
    empty: int = 0
    refused: list[Refusal] = field(default_factory=list)


def encode_to_database(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    database: Database,
    workers: int = 2,
    progress: Progress | None = None,
    segmenter: Segmenter | None = None,
) -> Summary:
    """Encodes the frames that a database lacks and adds them to it.

    A frame that cannot be read or encoded is refused and the run goes on. Frames land in parts
    of `PART_ROWS`; on an exception, Ctrl-C among them, those that wait for their part to fill
    are written before it goes on its way.

    Args:
        head: its settings must have the database's fingerprint.
        files: from `find_label_files`; with a segmenter, from `find_image_files`.
        database: where the raw descriptors go.
        workers: threads that read and decode ahead of the encoder.
        progress: told of every frame that is done.
        segmenter: makes the label maps, of the head's label space; without, they are read.

    Raises:
        ValueError: the fingerprints differ, or the segmenter does not fit.
        OSError: the database cannot be written.
    """
    database.require(head.config)
    known = database.digests()
    fresh = [file for file in files if file.frame not in known]
    summary = Summary(already_there=len(files) - len(fresh))
    tell = progress or _tell_nobody
    tell(summary.already_there)
    waiting: list[Encoded] = []
    try:
        for frame in encode(head, fresh, workers, segmenter):
            if isinstance(frame, Refusal):
                summary.refused.append(frame)
            else:
                waiting.append(frame)
            if len(waiting) == PART_ROWS:
                _write(waiting, database, summary)
            tell(1)
    finally:
        _write(waiting, database, summary)
    return summary


def encode_to_memory(
    head: SSRVLAD,
    files: Sequence[FrameFile],
    workers: int = 2,
    progress: Progress | None = None,
    segmenter: Segmenter | None = None,
) -> tuple[FrameSet, list[Refusal]]:
    """Encodes frames in order; arguments as for `encode_to_database`."""
    encoded: list[Encoded] = []
    refused: list[Refusal] = []
    tell = progress or _tell_nobody
    for frame in encode(head, files, workers, segmenter):
        if isinstance(frame, Refusal):
            refused.append(frame)
        else:
            encoded.append(frame)
        tell(1)
    descriptors = torch.zeros(len(encoded), head.config.length)
    for row, (_, descriptor) in enumerate(encoded):
        descriptors[row] = descriptor
    records = [record for record, _ in encoded]
    frames = FrameSet(
        frames=tuple(record.frame for record in records),
        sequences=tuple(record.sequence for record in records),
        descriptors=descriptors,
        poses=np.array([(r.x, r.y, r.heading) for r in records], np.float64).reshape(-1, 3),
        empty=~descriptors.any(dim=1).numpy(),
    )
    return frames, refused


def encode(
    head: SSRVLAD, files: Sequence[FrameFile], workers: int, segmenter: Segmenter | None = None
) -> Iterator[Encoded | Refusal]:
    """Encodes frames in order, in batches of frames of like size, read ahead by threads."""
    labelled = _label_maps(head, files, workers, segmenter)
    while chunk := list(islice(labelled, BATCH)):
        results: list[Encoded | Refusal | None] = [None] * len(chunk)
        alike: dict[object, list[tuple[int, FrameFile, LabelMap]]] = {}
        for place, (file, labels) in enumerate(chunk):
            if isinstance(labels, ValueError):
                results[place] = Refusal(file.frame, f"{file.path}: {labels}")
            else:
                alike.setdefault((labels.shape, labels.dtype), []).append((place, file, labels))
        for members in alike.values():
            described = _describe(head, [(file, labels) for _, file, labels in members])
            for (place, _, _), result in zip(members, described, strict=True):
                results[place] = result
        yield from (result for result in results if result is not None)


def _describe(
    head: SSRVLAD, batch: Sequence[tuple[FrameFile, LabelMap]]
) -> list[Encoded | Refusal]:
    """Describes frames of one size and dtype; if the batch is refused, one by one."""
    device = next(head.buffers()).device
    try:
        stack = torch.from_numpy(np.stack([labels for _, labels in batch])).to(device)
        descriptors = head(stack).cpu()
    except ValueError as error:
        if len(batch) == 1:
            file = batch[0][0]
            return [Refusal(file.frame, f"{file.path}: {error}")]
        return [result for frame in batch for result in _describe(head, [frame])]
    return [
        Encoded(_record(file, labels, head.config.labels_as), descriptor)
        for (file, labels), descriptor in zip(batch, descriptors, strict=True)
    ]


def _record(file: FrameFile, labels: LabelMap, labels_as: str) -> FrameRecord:
    height, width = labels.shape
    return FrameRecord(
        file.sequence, file.name, labels_as, height, width, digest(labels), *file.pose
    )


def _label_maps(
    head: SSRVLAD, files: Sequence[FrameFile], workers: int, segmenter: Segmenter | None
) -> Iterator[tuple[FrameFile, LabelMap | ValueError]]:
    if segmenter is None:
        read = partial(read_label_map, space=head.label_space)
        return read_ahead(read, files, workers, _READ_AHEAD)
    if segmenter.label_space != head.label_space:
        raise ValueError(
            f"the segmenter gives labels of {segmenter.label_space.name}, the head reads "
            f"{head.label_space.name}"
        )
    return segmenter.label_maps(files, workers)


def _write(waiting: list[Encoded], database: Database, summary: Summary) -> None:
    if not waiting:
        return
    descriptors = torch.stack([frame.descriptor for frame in waiting])
    database.append([frame.record for frame in waiting], descriptors)
    summary.encoded += len(waiting)
    summary.empty += int((~descriptors.any(dim=1)).sum())
    waiting.clear()


def _tell_nobody(done: int) -> None:
    pass
