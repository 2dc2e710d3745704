"""What a worker does: it reads label maps and describes frames in batches, by all channels."""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..channels.channel import PICTURE, Channel, View
from ..database.frames import FrameRecord
from ..datasets.frame_files import FrameFile
from ..datasets.image_files import read_image
from ..datasets.label_files import LabelMap, digest, read_label_map
from ..datasets.workers import in_order
from ..taxonomy import LabelSpace
from .results import Encoded, Skipped

BATCH = 16
"""Frames of one size in a batch; a larger batch does not fit in the processor's cache."""


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


class Describer:
    """Items of a label space -> descriptors by some channels, from anchors, the ``columns``, if
    any, with an origin for their records, see `Database.add_origin`. It can be pickled."""

    def __init__(
        self,
        channels: Sequence[Channel],
        space: LabelSpace,
        columns: Sequence[int] = (),
        origin: str = "",
    ) -> None:
        self.channels, self.space = tuple(channels), space
        self.columns, self.origin = tuple(columns), origin

    def needs(self, what: str) -> bool:
        """Whether a channel needs labels, the picture or features of a view."""
        return any(what in channel.needs for channel in self.channels)

    def __call__(self, items: Sequence[Item]) -> list[Encoded | Skipped]:
        """The results of frames, in their order; a batch has one size and dtype, and its frames are
        described one by one if it fails."""
        items = read(self.space, items)
        results: dict[int, Encoded | Skipped] = {}
        groups: dict[object, list[int]] = {}
        for number, item in enumerate(items):
            if isinstance(item.labels, np.ndarray):
                groups.setdefault((item.labels.shape, item.labels.dtype), []).append(number)
            else:
                results[number] = _skipped(item, item.labels)
        batches = deque(
            group[first : first + BATCH]
            for group in groups.values()
            for first in range(0, len(group), BATCH)
        )
        while batches:
            numbers = batches.popleft()
            batch = [items[number] for number in numbers]
            try:
                described = self._described(batch)
            except ValueError as error:
                if len(batch) == 1:
                    results[numbers[0]] = _skipped(batch[0], error)
                else:  # one by one
                    batches.extendleft([number] for number in reversed(numbers))
                continue
            for row, (number, item) in enumerate(zip(numbers, batch, strict=True)):
                own = {name: values[row] for name, values in described.items()}
                results[number] = Encoded(self._record(item), own)
        return [results[number] for number in range(len(items))]

    def _described(self, batch: Sequence[Item]) -> dict[str, npt.NDArray[Any]]:
        """The descriptors of frames of one size, by the names of the channels."""
        pictured = self.needs(PICTURE)
        views = []
        for item in batch:
            picture = read_image(item.file) if pictured else None
            labels = np.asarray(item.labels)
            views.append(View(item.file.frame, labels, self.space, picture, item.features))
        channels = ((channel.column.name, channel) for channel in self.channels)
        return {name: channel.describe(views, self.columns).numpy() for name, channel in channels}

    def _record(self, item: Item) -> FrameRecord:
        file, size = item.file, np.asarray(item.labels).shape
        known = (*file.pose, file.stamp, item.signature, item.digest, *size, self.origin)
        return FrameRecord(file.sequence, file.name, *known)


def _skipped(item: Item, reason: object) -> Skipped:
    return Skipped(item.file.frame, f"{item.file.location}: {reason}")
