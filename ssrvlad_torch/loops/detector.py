"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from ..baselines.protocol import Frame
from ..database.database import Database
from ..database.frames import FrameRecord, checked_pose, is_text, numbers_of
from ..database.metadata import ExtraDescriptor
from ..database.rows import check_records
from ..datasets.label_files import digest
from ..descriptor import SSRVLAD, SweepHead
from ..encoding.extra_descriptors import extra_methods
from ..recognition.matching import real_tensor
from ..segmentation.features import NAME as FEATURES
from ..stages.front_end import as_tensor
from .config import LoopConfig
from .memory import Floats, FloatVectors, Memory
from .result import LoopResult
from .sign_memory import SignVectors
from .tracker import Tracker

COLUMNS = (-4, 0, 4)
"""Anchors of a frame, see `recognition.sweep`."""


class LoopDetector:
    """Decides for each frame of a stream whether its place was seen before.

    A frame is described from several anchors and compared with all earlier frames, each without the
    mean of its own sequence. A Bayes filter (`loops.tracker`) follows the stream; its states are
    the earlier frames, the same frames run backwards, which only chance makes probable, and "a new
    place". Excluded frames are states too, except for the last `tracker.RECENT`: where one of them
    is more probable than the old frames, no loop is closed.

    One thread updates; another may `save` at the same time.

    Args:
        config: the settings; without, the defaults.
        head: describes label maps; given descriptors must have its settings. Without, the preset
            ``default``.
        extra: methods that describe frames by their pictures. The scores of all methods
            are fused; a method weighs by the lead of its first candidates so far.

    Examples:
        >>> detector = LoopDetector(head=SSRVLAD())
        >>> detector.update(torch.full((60, 80), 7), "drive/000000").reason.value
        'no_candidate'
    """

    def __init__(
        self,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
        extra: Sequence[ExtraDescriptor] = (),
    ) -> None:
        if not isinstance(config, LoopConfig | None):
            raise ValueError(f"expected config as a LoopConfig, got {type(config).__name__}")
        self.config = config or LoopConfig()
        self.head = head or SSRVLAD()
        self.extra, self._methods = tuple(extra), extra_methods(extra)
        self._memory = Memory(self.head.config.length)
        self._others = {
            each.name: SignVectors(each.cells) if each.cells else FloatVectors(each.width)
            for each in extra
        }
        self._tracker = Tracker(self.config, self._memory, self._others)
        self._sequence: str | None = None
        self._stamps: dict[str, float] = {}
        self._arrivals = 0
        self._unsaved: list[FrameRecord] = []
        self._updating, self._saving = threading.Lock(), threading.Lock()

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
        return self._memory.poses.copy()

    @property
    def descriptor(self) -> Floats:
        """``(D,)`` float32, a copy, of the last frame.

        Raises:
            IndexError: there is no frame yet.
        """
        if not len(self):
            raise IndexError("no frame was seen yet")
        last: Floats = self._memory.descriptors(len(self) - 1, len(self))[0]
        return last

    @property
    def columns(self) -> tuple[int, ...]:
        """Anchors from which frames are described; empty for the usual anchor alone."""
        return COLUMNS if self.config.sweep and self.head.config.aggregation == "harmonics" else ()

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each method; empty without extra methods."""
        return self._tracker.weights if self._others else {}

    def encoder(self) -> SSRVLAD:
        """A head that describes frames for `observe`, from all `columns`."""
        return SweepHead(self.head.config, self.columns) if self.columns else self.head

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
                descriptor.
            frame_id: ``<sequence>/<name>``; the filter starts anew with each sequence.
            stamp: seconds, not less than those of earlier frames of the sequence.
            pose: x and y in metres, and heading in radians if it is known.
            picture: ``(H, W, 3)`` uint8 in RGB, for the extra methods that describe pictures.
            features: from `Segmenter.segment`, if they are an extra method.

        Raises:
            ValueError: the frame cannot be described, its id has another form or was there before,
                or a stamp or pose is wrong. The detector is unchanged.
        """
        sequence, _, name = frame_id.rpartition("/") if is_text(frame_id) else ("", "", "")
        if not (sequence and name):
            raise ValueError(f"expected a frame's id <sequence>/<name>, got {frame_id!r}")
        place = checked_pose(pose, frame_id)
        stamps = [math.nan] if stamp is None else numbers_of([stamp])
        if not stamps:
            raise ValueError(f"frame {frame_id!r}: expected a stamp in seconds, got {stamp!r}")
        record = FrameRecord(sequence, name, *place, stamps[0])
        tensor = as_tensor(view)
        if picture is not None and not self._methods:
            raise ValueError("got a picture, but the detector has no extra method to describe it")
        frame = Frame(frame_id, image=picture)
        others = {each.name: each.encode_query([frame])[0] for each in self._methods}
        if features is not None:
            others[FEATURES] = real_tensor(features, "features")
        if tensor.ndim == 1:
            return self.observe(record, tensor, others)
        swept = self.head.sweep(tensor[None], self.columns) if self.columns else None
        [descriptor] = self.head(tensor[None]) if swept is None else swept
        labels = (tensor.argmax(0) if tensor.ndim == 3 else tensor).cpu().numpy()
        height, width = labels.shape
        record = record._replace(digest=digest(labels), height=height, width=width)
        return self.observe(record, descriptor, others)

    def observe(
        self, record: FrameRecord, descriptor: Tensor, extra: Mapping[str, Tensor] | None = None
    ) -> LoopResult:
        """As `update`, for a frame that is encoded already.

        Args:
            record: the frame as a database stores it.
            descriptor: ``(D,)``, or ``(S, D)`` from S anchors with the usual one in the middle; of
                length 1 or zero.
            extra: ``(D',)``, or the signs of features, for each name of `extra`.

        Raises:
            ValueError: as for `update`.
        """
        check_records([record], [record.origin])
        extra = extra or {}
        swept = self._memory.checked(descriptor, record.frame)
        if extra.keys() != self._others.keys():
            names, got = (", ".join(each) or "nothing" for each in (self._others, extra))
            raise ValueError(f"frame {record.frame!r}: expected extra {names}, got {got}")
        others: dict[str, npt.NDArray[Any]] = {
            name: memory.checked(extra[name], record.frame) for name, memory in self._others.items()
        }
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
            if record.sequence != self._sequence:
                self._start_sequence(record.sequence)
                self._tracker.start_sequence()
            result = self._tracker.step(record.frame, swept, others)
            centre = swept[len(swept) // 2]
            self._memory.append(record.frame, (record.x, record.y, record.heading), centre)
            for name, [vector] in others.items():
                self._others[name].add(vector)
            self._unsaved.append(record._replace(arrival=self._arrivals))
            self._arrivals += 1
            self._sequence = record.sequence
            if not math.isnan(record.stamp):
                self._stamps[record.sequence] = record.stamp
        return result

    def save(self, database: Database) -> None:
        """Adds the frames since the last `save` or `load` to a database, as raw descriptors.

        Args:
            database: the one that was loaded or saved to before; for the first save an empty one.

        Raises:
            ValueError: the database has another fingerprint, or other frames than those saved.
            OSError: writing failed; the database is unchanged.
        """
        with self._saving:
            database.require(self.head.config, self.extra)
            with self._updating:
                fresh, last = self._unsaved.copy(), len(self)
                saved = last - len(fresh)
                vectors = self._memory.descriptors(saved, last)
                others = {name: v.descriptors(saved, last) for name, v in self._others.items()}
            if len(database) != saved:
                raise ValueError(
                    f"{database.path} holds {len(database)} frames; {saved} of this stream were "
                    "saved"
                )
            if fresh:
                database.append(fresh, vectors, others)
            with self._updating:
                del self._unsaved[: len(fresh)]

    @classmethod
    def load(
        cls, database: Database, config: LoopConfig | None = None, head: SSRVLAD | None = None
    ) -> LoopDetector:
        """A detector that knows the frames of a database, as if they came before.

        Frames that a detector saved are in the order in which they came. Frames that were encoded
        from files come before them, in whichever order workers stored them: sequences in the order
        in which they were added, the frames of each in the order of their names. The next frame
        starts a sequence for the filter, and the weights of fused methods are found anew: they
        come from the scores of frames from all anchors, which a database does not store.

        Args:
            database: of raw descriptors.
            config: as for `LoopDetector`.
            head: with the fingerprint of the database; without, a head of the database's settings.

        Raises:
            ValueError: the fingerprints differ, or a file is damaged; the message names the file.
        """
        head = head or SSRVLAD(database.config)
        database.require(head.config)
        detector = cls(config, head, database.extra)
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
        vectors = frames.descriptors.numpy()
        for sequence, part in groupby(order, lambda row: frames.sequences[row]):
            rows = [*part]
            detector._start_sequence(sequence)
            for row in rows:
                pose = frames.poses[row].tolist()
                detector._memory.append(frames.frames[row], pose, vectors[row])
                if not np.isnan(frames.stamps[row]):
                    detector._stamps[sequence] = float(frames.stamps[row])
            for name, others in detector._others.items():
                others.extend(frames.extra[name][rows])
        detector._tracker.extend(len(detector) - 1)  # as before the last frame came
        return detector

    def _start_sequence(self, sequence: str) -> None:
        """The next frame is of this sequence; the last one may be too, if it was loaded."""
        if self._memory.sequence != sequence:
            for memory in (self._memory, *self._others.values()):
                memory.start_sequence()
