"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import FEATURES, PICTURE, Channel, View, channels_of, new_channels
from ..channels.label_shapes import LabelShapes
from ..database.database import Database
from ..database.frames import FrameRecord, checked_pose, is_text, numbers_of
from ..database.rows import check_records
from ..datasets.label_files import digest
from ..datasets.names import split_id
from ..descriptor import SSRVLAD
from ..native.loops import SCAN_ABOVE, Array, Found
from ..native.loops import Channel as Described
from ..recognition.matching import real_tensor
from ..segmentation.networks import AUTO
from ..segmentation.segmenter import Segmented, Segmenter
from ..stages.front_end import as_tensor
from ..taxonomy import LabelSpace
from .config import LoopConfig
from .live import checked, live, require_lengths
from .memory import Memory
from .result import LoopResult, Place, Reason

COLUMNS = (-4, 0, 4)
"""Anchors of a frame, see `recognition.sweep`."""

REPLAYED = 100
"""Frames that a loaded detector goes through again, to know where it is: twice what it excludes."""


class LoopDetector:
    """Decides for each frame of a stream whether its place was seen before.

    A frame is described from several anchors and compared with all earlier frames, each without the
    mean of its own stretch: a sequence, or what is between gaps of it. A Bayes filter follows the
    stream; its states are the earlier frames, the same frames run backwards, which only chance
    makes probable, and "a new place". Excluded frames are states too, except for the last
    `reference.RECENT`: where one of them is more probable than the old frames, no loop is closed.
    All of that is the native core's; `loops.reference` says it plainly.

    One thread updates; another may `save` at the same time.

    Args:
        config: the settings; without, the defaults.
        head: describes label maps; given descriptors must have its settings. Without, the preset
            ``default``.
        channels: what is known of frames beside their label maps. The scores of all channels are
            fused; a channel weighs by the lead of its first candidates so far.

    Examples:
        >>> import torch
        >>> from ssrvlad_torch import SSRVLAD, LoopDetector
        >>> detector = LoopDetector(head=SSRVLAD())
        >>> detector.update(torch.full((60, 80), 7), "drive/000000").reason.value
        'no_candidate'
    """

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
        self._described = [
            Described(name, shape, dtype, each.trust)
            for each in self.channels
            for name, _, shape, dtype in [each.column]
        ]
        self._loops, self._memory = live(self._described, self.config), Memory()
        self._sequence: str | None = None
        self._stamps: dict[str, float] = {}
        self._arrivals = 0
        self._unsaved: list[FrameRecord] = []
        self._updating, self._saving = threading.Lock(), threading.Lock()

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
        return len(self._memory)

    def __repr__(self) -> str:
        last = f", last {self._memory.frames[-1]}" if len(self) else ""
        return (
            f"LoopDetector({len(self)} frames{last}, {self.config}, {self.head.config.fingerprint})"
        )

    def __contains__(self, frame: object) -> bool:
        return frame in self._memory.rows

    @property
    def frames(self) -> list[str]:
        """Ids of all frames in order."""
        return self._memory.frames.copy()

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` float64, a copy: x and y in metres, heading in radians, NaN where unknown."""
        return self._memory.poses

    @property
    def descriptor(self) -> npt.NDArray[np.float32]:
        """``(D,)`` float32, a copy, of the last frame.

        Raises:
            IndexError: there is no frame yet.
        """
        if not len(self):
            raise IndexError("no frame was seen yet")
        first, last = self._described[0].name, len(self)
        descriptor: npt.NDArray[np.float32] = self._loops.descriptors(first, last - 1, last)[0]
        return descriptor

    @property
    def columns(self) -> tuple[int, ...]:
        """Anchors from which frames are described; empty for the usual anchor alone."""
        return COLUMNS if self.config.sweep and self.head.config.aggregation == "harmonics" else ()

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each channel; empty if there is one."""
        return self._loops.weights if len(self.channels) > 1 else {}

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
        place = checked_pose(pose, frame_id)
        stamps = [math.nan] if stamp is None else numbers_of([stamp])
        if not stamps:
            raise ValueError(f"frame {frame_id!r}: expected a stamp in seconds, got {stamp!r}")
        record = FrameRecord(sequence, name, *place, stamps[0])
        if self.segmenter and np.shape(view)[2:] == (3,):
            picture, (view, features) = np.asarray(view), self._labelled(view)
        tensor, (first, *others) = as_tensor(view), self.channels
        if features is not None:
            features = real_tensor(features, "features").numpy(force=True)
        for need, given in ((PICTURE, picture), (FEATURES, features)):
            if given is not None and not (self.segmenter or self._needs(need)):
                raise ValueError(f"got {need}, but the detector has no channel that describes them")
        seen = View(frame_id, picture=picture, features=features)
        described = {channel.column.name: channel.describe([seen])[0] for channel in others}
        if tensor.ndim == 1:
            return self.observe(record, {first.column.name: tensor, **described})
        swept = self.head.sweep(tensor[None], self.columns) if self.columns else None
        [descriptor] = self.head(tensor[None]) if swept is None else swept
        labels = (tensor.argmax(0) if tensor.ndim == 3 else tensor).cpu().numpy()
        height, width = labels.shape
        record = record._replace(digest=digest(labels), height=height, width=width)
        return self.observe(record, {first.column.name: descriptor, **described})

    @property
    def scans(self) -> bool:
        """Whether each frame is compared with all old frames by a part of their features, and by
        all channels with only some; see `native.loops.SCAN_ABOVE`."""
        signs = any(channel.dtype == "uint8" for channel in self._described)
        return signs and len(self) - self.config.exclude > SCAN_ABOVE

    def _needs(self, what: str) -> bool:
        return any(what in channel.needs for channel in self.channels)

    def _labelled(self, picture: Any) -> Segmented:
        """What the network says of a picture."""
        assert self.segmenter
        [said] = self.segmenter.segment([picture], self._needs(FEATURES))
        return said

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
        swept = self._checked(descriptors, record.frame)
        with self._updating:
            last = self._stamps.get(record.sequence, -math.inf)
            if record.frame in self:
                raise ValueError(f"frame {record.frame!r} was there before")
            if math.isinf(record.stamp):
                raise ValueError(
                    f"frame {record.frame!r}: expected a finite stamp, got {record.stamp}"
                )
            if record.stamp < last:
                raise ValueError(
                    f"frame {record.frame!r}: expected a stamp from {last} on, got {record.stamp}"
                )
            starts = record.sequence != self._sequence
            found = self._loops.update(swept, record.stamp, starts, torch.get_num_threads())
            result = self._result(record.frame, found)
            self._memory.append(record)
            self._unsaved.append(record._replace(arrival=self._arrivals))
            self._arrivals += 1
            self._sequence = record.sequence
            if not math.isnan(record.stamp):
                self._stamps[record.sequence] = record.stamp
        return result

    def _checked(self, descriptors: Mapping[str, Tensor] | Tensor, frame: str) -> dict[str, Array]:
        """The descriptors of a frame from its anchors by the names of the channels; others are a
        ValueError."""
        given, names = descriptors, [each.name for each in self._described]
        if isinstance(given, Tensor):
            given = {names[0]: given}
        if given.keys() != {*names}:
            expected, got = (", ".join(each) or "nothing" for each in (names, given))
            raise ValueError(f"frame {frame!r}: expected descriptors by {expected}, got {got}")
        arrays = {name: each.numpy(force=True) for name, each in given.items()}
        return {each.name: checked(each, arrays[each.name], frame) for each in self._described}

    def _result(self, frame: str, found: Found) -> LoopResult:
        """What was found, by the ids of frames."""
        reason, frames = Reason(found.reason), self._memory.frames
        if found.candidate is None:
            return LoopResult(frame, reason)
        ahead = self._memory.ahead(found) if reason is Reason.ACCEPTED else None
        places = tuple(Place(frames[row], likely) for row, likely in found.places)
        candidate = frames[found.candidate]
        return LoopResult(frame, reason, candidate, found.score, found.probability, ahead, places)

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
            with self._updating:
                fresh, last = self._unsaved.copy(), len(self)
                saved = last - len(fresh)
                described = {
                    name: self._loops.descriptors(name, saved, last) for name, *_ in self._described
                }
            if len(database) != saved:
                raise ValueError(
                    f"{database.path} holds {len(database)} frames; {saved} of this stream were "
                    "saved"
                )
            if fresh:
                database.append(fresh, described)
            with self._updating:
                del self._unsaved[: len(fresh)]

    @classmethod
    def load(
        cls, database: Database, config: LoopConfig | None = None, head: SSRVLAD | None = None
    ) -> LoopDetector:
        """A detector that knows the frames of a database, as if they came before.

        Frames that a detector saved are in the order in which they came. Frames that were encoded
        from files come before them, in whichever order workers stored them: sequences in the order
        in which they were added, the frames of each in the order of their names. The last
        `REPLAYED` frames are gone through again, from the usual anchor, which alone a database
        stores: the stream goes on where it was. Weights of fused channels, and how closely places
        are alike by chance, are then known of these frames alone.

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
        frames = database.load()
        known = database.known()
        names = dict.fromkeys(known.table["sequence"].to_pylist())
        added = {name: number for number, name in enumerate(names)}
        arrivals = dict(zip(known, known.table["arrival"].to_pylist(), strict=True))
        order = sorted(
            range(len(frames)),
            key=lambda row: (arrivals[frames.frames[row]], added[frames.sequences[row]]),
        )
        detector._arrivals = max(arrivals.values(), default=-1) + 1
        runs = [[*part] for _, part in groupby(order, lambda row: frames.sequences[row])]
        for rows in runs:
            records = []
            for row in rows:
                x, y, heading = frames.poses[row].tolist()
                sequence, name = split_id(frames.frames[row])
                stamp = float(frames.stamps[row])
                records.append(FrameRecord(sequence, name, x, y, heading, stamp))
            described = {name: each[rows] for name, each in frames.channels.items()}
            detector._remember(records, described, REPLAYED if rows is runs[-1] else 0)
        return detector

    def _remember(
        self, records: Sequence[FrameRecord], described: Mapping[str, Tensor], replayed: int
    ) -> None:
        """Takes the frames of a sequence, the last ones as if they came now, by their descriptors
        ``(N, *shape)`` in each channel."""
        stamps = np.array([record.stamp for record in records])
        arrays = {name: each.numpy() for name, each in described.items()}
        for each in self._described:
            if each.dtype == "float32":
                require_lengths(arrays[each.name], [record.frame for record in records])
        now = max(0, len(records) - replayed)
        known = {name: each[:now] for name, each in arrays.items()}
        self._loops.extend(known, stamps[:now], np.arange(now) == 0)
        for row in range(now, len(records)):
            self._loops.update(
                {name: each[row] for name, each in arrays.items()}, stamps[row], not row
            )
        for record in records:
            self._memory.append(record)
        self._sequence = records[-1].sequence
        if not np.isnan(stamps).all():
            self._stamps[self._sequence] = float(np.nanmax(stamps))


def _require_database(given: object) -> None:
    if not isinstance(given, Database):
        raise ValueError(f"expected a database, such as Database.open(path), got {given!r}")
