"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import FEATURES, PICTURE, Channel, View, channels_of, new_channels
from ..channels.label_shapes import LabelShapes
from ..database.database import Database
from ..database.frames import FrameRecord, checked_pose, is_text, numbers_of
from ..database.rows import StoredRecords, check_records
from ..datasets.label_files import digest
from ..datasets.names import split_id
from ..descriptor import SSRVLAD
from ..native.loops import SCAN_ABOVE, Array, Loops, LoopStep, Reason
from ..native.loops import Channel as StreamChannel
from ..recognition.matching import real_tensor
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmenter
from ..stages.front_end import as_tensor
from ..taxonomy import LabelSpace
from .config import LoopConfig
from .frame_log import FrameLog
from .result import LoopResult, Place

COLUMNS = (-4, 0, 4)
"""Anchors of a frame, see `recognition.sweep`."""

REPLAYED = 100
"""Frames that a loaded detector goes through again, to know where it is: twice what it excludes."""


class LoopDetector:
    """Decides for each frame of a stream whether its place was seen before.

    A frame is compared with all earlier frames, each without the mean of its own stretch: a
    sequence, or what is between gaps of it. A Bayes filter follows the stream, see
    docs/concepts/equations.md.

    One thread updates; another may `save` at the same time. An interrupt, such as Ctrl-C, leaves
    the detector with the frame or without it, see ``frame in detector``; a `save` can be repeated.

    Args:
        config: the settings; without, the defaults.
        head: describes label maps; given descriptors must have its settings. Without, the preset
            ``default``.
        channels: what is known of frames beside their label maps. The scores of all channels are
            fused; a channel weighs by the lead of its first candidates so far.

    Attributes:
        segmenter: labels pictures that `update` gets; ``None`` until it is set, see
            `from_pretrained`.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch import SSRVLAD, LoopDetector
        >>> detector = LoopDetector(head=SSRVLAD())
        >>> detector.update(torch.full((60, 80), 7), "drive/000000").reason.value
        'no_candidate'
    """

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError("a LoopDetector cannot be copied or pickled: save and load it")

    def __init__(
        self,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
        channels: Sequence[Channel] = (),
    ) -> None:
        if not isinstance(config, LoopConfig | None):
            raise ValueError(f"expected config as a LoopConfig, got {type(config).__name__}")
        self.config = config or LoopConfig()
        self.segmenter: Segmenter | None = None
        self.head = head or SSRVLAD()
        self.channels: tuple[Channel, ...] = (LabelShapes(self.head), *channels)
        columns = [(channel.column, channel.trust) for channel in self.channels]
        streamed = [StreamChannel(of.name, of.shape, of.dtype, trust) for of, trust in columns]
        self._stream = Loops(streamed, self.config.exclude, self.config.threshold)
        self._log = FrameLog(self._stream)
        self._saved, self._begun = 0, 0  # rows before these: in a database, and perhaps in it
        self._updating, self._saving = threading.RLock(), threading.RLock()

    @classmethod
    def from_pretrained(
        cls,
        network: str | Path | Segmenter,
        labels_as: str | LabelSpace = AUTO,
        config: LoopConfig | None = None,
        channels: Sequence[str] | None = None,
    ) -> LoopDetector:
        """A detector whose `update` takes pictures.

        Args:
            network: labels them; a name, see `open_network`, or a `Segmenter`.
            labels_as: label space of the classes of a named one; with ``"auto"`` its own.
            config: the settings; without, the defaults.
            channels: names of what is known of frames beside their label maps; by default all that
                the network gives.

        Raises:
            ValueError: the network cannot be used, or gives no such channel.
        """
        segmenter = (
            network if isinstance(network, Segmenter) else Segmenter.load(network, labels_as)
        )
        head = SSRVLAD.from_preset("default", labels_as=segmenter.label_space)
        detector = cls(config, head, new_channels(channels, head, segmenter)[1:])
        detector.segmenter = segmenter
        return detector

    def __len__(self) -> int:
        with self._updating:
            return len(self._log)

    def __repr__(self) -> str:
        last = f", last {self.frames[-1]}" if len(self) else ""
        return (
            f"LoopDetector({len(self)} frames{last}, {self.config}, {self.head.config.fingerprint})"
        )

    def __contains__(self, frame: object) -> bool:
        with self._updating:
            return frame in self._log

    @property
    def frames(self) -> list[str]:
        """Ids of all frames in order."""
        with self._updating:
            return [record.frame for record in self._log.since(0)]

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` float64, a copy: x and y in metres, heading in radians, NaN where unknown."""
        with self._updating:
            return self._log.poses

    @property
    def descriptor(self) -> npt.NDArray[np.float32]:
        """``(D,)`` float32, a copy, of the last frame.

        Raises:
            IndexError: there is no frame yet.
        """
        last, name = len(self), self._stream.channels[0].name
        if not last:
            raise IndexError("no frame was seen yet")
        descriptor: npt.NDArray[np.float32] = self._stream.descriptors(name, last - 1, last)[0]
        return descriptor

    @property
    def columns(self) -> tuple[int, ...]:
        """Anchors from which frames are described; empty for the usual anchor alone."""
        return COLUMNS if self.config.sweep and self.head.config.aggregation == "harmonics" else ()

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each channel; empty if there is one."""
        return self._stream.weights if len(self.channels) > 1 else {}

    def update(
        self,
        view: Tensor | npt.NDArray[Any],
        frame_id: str,
        stamp: float | None = None,
        pose: Sequence[float] | None = None,
        picture: npt.NDArray[np.uint8] | None = None,
        features: npt.NDArray[np.uint8] | None = None,
    ) -> LoopResult:
        """Looks for the place of the next frame among the earlier frames, then stores it.

        Args:
            view: ``(H, W)`` integer label map, ``(C, H, W)`` class scores, or the frame's ``(D,)``
                descriptor; with a network, see `from_pretrained`, an ``(H, W, 3)`` uint8 picture in
                RGB.
            frame_id: ``<sequence>/<name>``; the filter starts anew with each sequence.
            stamp: seconds, not less than those of earlier frames of the sequence; after ten minutes
                without a frame, another view is as of another sequence.
            pose: x and y in metres, and heading in radians if it is known.
            picture: ``(H, W, 3)`` uint8 in RGB, for the channels that describe pictures.
            features: from `Segmenter.segment`, if they are a channel.

        Raises:
            ValueError: the frame cannot be described, its id has another form or was there before,
                or a stamp or pose is wrong. The detector is unchanged.
        """
        sequence, name = split_id(frame_id) if is_text(frame_id) else ("", "")
        if not (sequence and name):
            raise ValueError(f"expected a frame's id <sequence>/<name>, got {frame_id!r}")
        stamps = [math.nan] if stamp is None else numbers_of([stamp])
        if not stamps:
            raise ValueError(f"frame {frame_id!r}: expected a stamp in seconds, got {stamp!r}")
        record = FrameRecord(sequence, name, *checked_pose(pose, frame_id), stamps[0])
        if self.segmenter and np.shape(view)[2:] == (3,):
            picture = np.asarray(view)
            [(view, features)] = self.segmenter.segment([picture], self._needs(FEATURES))
        tensor = as_tensor(view)
        if features is not None:
            features = real_tensor(features, "features").numpy(force=True)
        for need, array in ((PICTURE, picture), (FEATURES, features)):
            if array is not None and not (self.segmenter or self._needs(need)):
                raise ValueError(f"got {need}, but the detector has no channel that describes them")
        views = [View(frame_id, picture=picture, features=features)]
        described = {of.column.name: of.describe(views)[0] for of in self.channels[1:]}
        descriptor = tensor
        if tensor.ndim > 1:
            batch, columns = tensor[None], self.columns
            [descriptor] = self.head.sweep(batch, columns) if columns else self.head(batch)
            labels = (tensor.argmax(0) if tensor.ndim == 3 else tensor).cpu().numpy()
            height, width = labels.shape
            record = record._replace(digest=digest(labels), height=height, width=width)
        return self.observe(record, {self.channels[0].column.name: descriptor, **described})

    @property
    def scans(self) -> bool:
        """Whether there are more than `native.loops.SCAN_ABOVE` old frames with features: a frame
        is then compared with all of them by a part of these, and by all channels with only some."""
        signs = any(channel.dtype == "uint8" for channel in self._stream.channels)
        return signs and len(self) - self.config.exclude > SCAN_ABOVE

    def _needs(self, what: str) -> bool:
        return any(what in channel.needs for channel in self.channels)

    def observe(
        self, record: FrameRecord, descriptors: Mapping[str, Tensor] | Tensor
    ) -> LoopResult:
        """As `update`, for a frame that is described already.

        Args:
            record: the frame as a database stores it.
            descriptors: of each channel by its name, or of the only one: as it is stored, or from S
                anchors ``(S, *shape)`` with the usual one in the middle; vectors are of length 1 or
                zero.

        Raises:
            ValueError: as for `update`.
        """
        check_records([record], [record.origin])
        arrays = self._checked(descriptors, record.frame)
        with self._updating:
            log, last = self._log, self._log.last_stamp(record.sequence)
            if record.frame in log:
                raise ValueError(f"frame {record.frame!r} was there before")
            if math.isinf(record.stamp):
                raise ValueError(
                    f"frame {record.frame!r}: expected a finite stamp, got {record.stamp}"
                )
            if record.stamp < last:
                raise ValueError(
                    f"frame {record.frame!r}: expected a stamp from {last} on, got {record.stamp}"
                )
            previous = log[-1] if len(log) else FrameRecord("", "")
            log.enter([record._replace(arrival=previous.arrival + 1)])
            starts = record.sequence != previous.sequence
            try:
                step = self._stream.update(arrays, record.stamp, starts, torch.get_num_threads())
            except ValueError as error:
                raise ValueError(f"frame {record.frame!r}: {error}") from error
            return self._result(record.frame, step)

    def _checked(self, descriptors: Mapping[str, Tensor] | Tensor, frame: str) -> dict[str, Array]:
        """The descriptors of a frame by the names of the channels; others are a ValueError."""
        names = [channel.name for channel in self._stream.channels]
        if isinstance(descriptors, Tensor):
            descriptors = {names[0]: descriptors}
        if descriptors.keys() != {*names}:
            expected, got = (", ".join(keys) or "nothing" for keys in (names, descriptors))
            raise ValueError(f"frame {frame!r}: expected descriptors by {expected}, got {got}")
        arrays = {}
        for channel in self._stream.channels:
            array = descriptors[channel.name].numpy(force=True)
            arrays[channel.name] = array.astype(np.float32) if array.dtype.kind == "f" else array
        return arrays

    def _result(self, frame: str, step: LoopStep) -> LoopResult:
        """The result of a frame by the ids of frames."""
        if step.candidate is None:
            return LoopResult(frame, step.reason)
        log = self._log
        ahead = log.ahead(step) if step.reason is Reason.ACCEPTED else None
        places = tuple(Place(log[row].frame, likely) for row, likely in step.places)
        candidate = log[step.candidate].frame
        return LoopResult(
            frame, step.reason, candidate, step.score, step.probability, ahead, places
        )

    def save(self, database: Database) -> None:
        """Adds the frames since the last `save` or `load` to a database, as raw descriptors.

        Args:
            database: the one that was loaded or saved to before; for the first save an empty one.

        Raises:
            ValueError: it is no database, or has another fingerprint or other frames than those
                saved.
            OSError: writing failed; the database is unchanged.
        """
        _require_database(database)
        with self._saving:
            columns = [channel.column for channel in self.channels[1:]]
            database.require(self.head.config, columns)
            stored = Database.open(database.path).known()  # with what an interrupted save added
            with self._updating:
                self._require_saved(database.path, stored)
                saved, last = self._saved, len(self._log)
                fresh = self._log.since(saved)
                described = {
                    name: self._stream.descriptors(name, saved, last)
                    for name, *_ in self._stream.channels
                }
            self._begun = last
            if fresh:
                database.append(fresh, described)
            self._saved = last

    def _require_saved(self, path: str, stored: StoredRecords) -> None:
        """Requires that a database holds what was saved; what a save began that was interrupted is
        saved if the database holds it."""

        def holds(rows: int) -> bool:
            record = self._log[rows - 1]
            return record.frame in stored and stored[record.frame].arrival == record.arrival

        if self._begun > self._saved and holds(self._begun):
            self._saved = self._begun
        if not (holds(self._saved) if self._saved else not stored):
            last = f"frame {self._log[self._saved - 1].frame!r}" if self._saved else "no frame"
            raise ValueError(
                f"{path}: expected the database of this stream, with {last}, got one of "
                f"{len(stored)} frames"
            )

    @classmethod
    def load(
        cls, database: Database, config: LoopConfig | None = None, head: SSRVLAD | None = None
    ) -> LoopDetector:
        """A detector that knows the frames of a database, as if they came before.

        Frames that a detector saved are in the order in which they came. Frames that were encoded
        from files come before them: sequences in the order in which they were added, the frames of
        each in the order of their names. The last `REPLAYED` frames are gone through again, from
        the usual anchor: the stream goes on where it was, with weights of channels and chance known
        of these frames alone.

        Args:
            database: of raw descriptors.
            config: as for `LoopDetector`.
            head: with the fingerprint of the database; without, a head of the database's settings.

        Raises:
            ValueError: it is no database, fingerprints differ, or a file is damaged; the message
                names the file.
        """
        _require_database(database)
        head = head or SSRVLAD(database.config)
        database.require(head.config)
        detector = cls(config, head, channels_of(database.columns[1:], head))
        frames, stored = database.load(), database.known()
        names = dict.fromkeys(stored.table["sequence"].to_pylist())
        added = {name: number for number, name in enumerate(names)}
        records = [stored[frame] for frame in frames.frames]
        places = [(record.arrival, added[record.sequence]) for record in records]
        order = sorted(range(len(records)), key=places.__getitem__)
        sequences = [[*rows] for _, rows in groupby(order, lambda row: records[row].sequence)]
        for rows in sequences:
            described = {name: of[rows].numpy() for name, of in frames.channels.items()}
            replayed = REPLAYED if rows is sequences[-1] else 0
            detector._remember([records[row] for row in rows], described, replayed)
        detector._saved = detector._begun = len(records)
        return detector

    def _remember(
        self, records: Sequence[FrameRecord], described: Mapping[str, Array], replayed: int
    ) -> None:
        """Takes the frames of a sequence, the last ones as if they came now, by their descriptors
        ``(N, *shape)`` in each channel."""
        stamps = np.array([record.stamp for record in records])
        self._log.enter(records)
        now = max(0, len(records) - replayed)
        earlier = {name: rows[:now] for name, rows in described.items()}
        self._stream.extend(earlier, stamps[:now], np.arange(now) == 0)
        for row in range(now, len(records)):
            descriptors = {name: rows[row] for name, rows in described.items()}
            self._stream.update(descriptors, stamps[row], not row)


def _require_database(database: object) -> None:
    if not isinstance(database, Database):
        raise ValueError(f"expected a database, such as Database.open(path), got {database!r}")
