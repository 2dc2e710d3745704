"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..baselines.protocol import Frame
from ..database.database import Database
from ..database.frames import FrameRecord
from ..database.metadata import ExtraDescriptor
from ..datasets.label_files import digest
from ..descriptor import SSRVLAD, SweepHead
from ..encoding.extra_descriptors import extra_methods
from ..front_end import as_tensor
from ..recognition.filter import Filter
from ..recognition.fusion import fused, weights_of, z_lead
from ..recognition.motion import MIN_SPREAD, Motion, likelihoods, moments, nearness
from ..recognition.recognise import SSR_VLAD
from .config import LoopConfig
from .memory import Floats, GrowingArray, Memory, Vectors, checked_vectors
from .result import LoopResult, Reason

COLUMNS = (-4, 0, 4)
"""Anchors of a frame, see `recognition.sweep`."""

MOTION = Motion(change=0.05, jump=0.05, unmapped=0.9, weight=0.3, level=2.5)
"""A stream comes to new places more often than a query of a map does. These settings and those of
frames of the same sequence are chosen on the cities that docs/loops.md learns thresholds on, not on
those that it measures."""

WEIGHT, LIKENESS = 0.5, 0.9
"""For frames of the same sequence: what one z-score counts, and its level as a part of the z-score
that three quarters of the frames have with the one before them."""

STRIDE = 50
"""The more frames a stream excludes, the denser it is: with so many, the frame before is one frame
before, with twice as many it is two."""

NEAR = 5
"""Frames on each side of a frame that show the same place."""

RECENT = 10
"""So old a frame is one that the present place may be held for, though it is no candidate yet."""


class LoopDetector:
    """Tells for each frame of a stream whether its place was seen before.

    A frame is compared with all earlier ones, standardised by the mean of all frames so far and
    from several anchors, and a Bayes filter (`recognition.filter`) follows the stream. Its states
    are the earlier frames and "a new place". The excluded frames are states too, from the
    `RECENT`-th on: where they fit as well as old ones, no loop is closed. Frames of one sequence
    share light and network: the better its neighbouring frames fit each other, the higher is the
    level for its old ones.

    One thread updates; another may `save` meanwhile.

    Args:
        config: the settings; without, the defaults.
        head: describes label maps; descriptors that are given must be of its settings. Without, the
            preset ``default``.
        beside: further methods that describe frames by their pictures. All scores are fused, each
            weighted by how far its first candidates were ahead so far.

    Example:
        >>> detector = LoopDetector(head=SSRVLAD())
        >>> detector.update(torch.full((60, 80), 7), "drive/000000").reason.value
        'no_candidate'
    """

    def __init__(
        self,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
        beside: Sequence[ExtraDescriptor] = (),
    ) -> None:
        self.config = config or LoopConfig()
        self.head = head or SSRVLAD()
        self.beside, self._methods = tuple(beside), extra_methods(beside)
        self._memory = Memory(self.head.config.length)
        self._others = {one.name: Vectors(one.width) for one in beside}
        self._leads = [0.0] * (1 + len(self._others))
        self._filter = Filter(motion=MOTION)
        self._began, self._neighbours = 0, GrowingArray(np.float64)
        self._sequence: str | None = None
        self._stamp = -math.inf
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
            IndexError: there was none yet.
        """
        if not len(self):
            raise IndexError("no frame was seen yet")
        last: Floats = self._memory.descriptors(len(self) - 1, len(self))[0]
        return last

    @property
    def columns(self) -> tuple[int, ...]:
        """Anchors from which frames are described; none for the usual one alone."""
        return COLUMNS if self.config.sweep and self.head.config.aggregation == "harmonics" else ()

    @property
    def weights(self) -> dict[str, float]:
        """What each of several methods weighs now; empty for the method alone."""
        names = [SSR_VLAD, *self._others] if self._others else []
        return dict(zip(names, weights_of(self._leads), strict=False))

    def encoder(self) -> SSRVLAD:
        """What describes frames for `observe`, each from all `columns`."""
        return SweepHead(self.head.config, self.columns) if self.columns else self.head

    def update(
        self,
        view: Tensor | npt.NDArray[Any],
        frame_id: str,
        stamp: float | None = None,
        pose: Sequence[float] | None = None,
        picture: npt.NDArray[np.uint8] | None = None,
    ) -> LoopResult:
        """Looks for the place of the next frame among the earlier ones, then remembers it.

        Args:
            view: ``(H, W)`` integer label map, ``(C, H, W)`` class scores, or the frame's ``(D,)``
                descriptor.
            frame_id: ``<sequence>/<name>``; with another sequence than the last frame's, the place
                is looked for anew.
            stamp: seconds, not less than that of the frame before in its sequence.
            pose: x and y in metres, and heading in radians if it is known.
            picture: ``(H, W, 3)`` uint8 in RGB, where there is something `beside`.

        Raises:
            ValueError: the frame cannot be described, its id is of another form or was there
                before, or a stamp or pose is wrong. The detector is as it was.
        """
        sequence, _, name = frame_id.rpartition("/")
        if not (sequence and name):
            raise ValueError(f"expected a frame's id <sequence>/<name>, got {frame_id!r}")
        place = _pose(pose, frame_id)
        seconds = math.nan if stamp is None else stamp
        record = FrameRecord(sequence, name, *place, seconds)
        given = as_tensor(view)
        if picture is not None and not self.beside:
            raise ValueError("a picture is given, and nothing describes it: expected it beside")
        frame = Frame(frame_id, image=picture)
        others = {each.name: each.encode_query([frame])[0] for each in self._methods}
        if given.ndim == 1:
            return self.observe(record, given, others)
        swept = self.head.sweep(given[None], self.columns) if self.columns else None
        [descriptor] = self.head(given[None]) if swept is None else swept
        labels = (given.argmax(0) if given.ndim == 3 else given).cpu().numpy()
        height, width = labels.shape
        record = record._replace(digest=digest(labels), height=height, width=width)
        return self.observe(record, descriptor, others)

    def observe(
        self,
        record: FrameRecord,
        descriptor: Tensor,
        beside: Mapping[str, Tensor] | None = None,
    ) -> LoopResult:
        """As `update`, for a frame that was encoded before, with what a database keeps of it.

        Args:
            record: of the frame.
            descriptor: ``(D,)``, or ``(S, D)`` from S anchors with the usual one in the middle; of
                length 1 or zero.
            beside: ``(D',)`` for each name of `beside`.

        Raises:
            ValueError: as for `update`.
        """
        given = beside or {}
        swept = checked_vectors(descriptor, record.frame, self.head.config.length)
        if given.keys() != self._others.keys():
            names, got = (", ".join(each) or "nothing" for each in (self._others, given))
            raise ValueError(f"frame {record.frame!r}: expected {names} beside, got {got}")
        others = {
            one.name: checked_vectors(given[one.name], record.frame, one.width)
            for one in self.beside
        }
        with self._updating:
            self._check(record)
            if record.sequence != self._sequence:
                self._filter.restart()
                self._began, self._neighbours = len(self), GrowingArray(np.float64)
                self._stamp = -math.inf
            result = self._look(record.frame, swept, others)
            centre = swept[len(swept) // 2]
            self._memory.append(record.frame, (record.x, record.y, record.heading), centre)
            for name, [vector] in others.items():
                self._others[name].add(vector)
            self._unsaved.append(record)
            self._sequence = record.sequence
            if not math.isnan(record.stamp):
                self._stamp = record.stamp
        return result

    def save(self, database: Database) -> None:
        """Adds the frames that came since the last `save` or `load` to a database, as raw
        descriptors.

        Args:
            database: the one that was loaded, or saved to before; at first an empty one.

        Raises:
            ValueError: the database has another fingerprint, or other frames than those saved.
            OSError: the disk refused; the database is as it was.
        """
        with self._saving:
            database.require(self.head.config, self.beside)
            with self._updating:
                fresh, last = self._unsaved.copy(), len(self)
                saved = last - len(fresh)
                vectors = self._memory.descriptors(saved, last)
                others = {n: known.descriptors(saved, last) for n, known in self._others.items()}
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
        cls,
        database: Database,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
    ) -> LoopDetector:
        """A detector that remembers the frames of any database.

        Sequences come in the order in which they were added, the frames of each in that of their
        names. As at the start of a sequence, the place is looked for anew.

        Args:
            database: raw descriptors, of the further methods too.
            config: as for `LoopDetector`.
            head: its settings must have the database's fingerprint; without, the database's.

        Raises:
            ValueError: the fingerprints differ, or a file is damaged; the message names it.
        """
        head = head or SSRVLAD(database.config)
        database.require(head.config)
        detector = cls(config, head, database.beside)
        frames = database.load()
        names = dict.fromkeys(database.known().column("sequence"))
        added = {name: number for number, name in enumerate(names)}
        order = sorted(range(len(frames.frames)), key=lambda row: added[frames.sequences[row]])
        vectors = frames.descriptors.numpy()
        for row in order:
            detector._memory.append(frames.frames[row], frames.poses[row].tolist(), vectors[row])
            for name, known in detector._others.items():
                known.add(frames.beside[name][row].numpy())
        return detector

    def _check(self, record: FrameRecord) -> None:
        """Whether the frame may be the next one."""
        frame, stamp = record.frame, record.stamp
        if frame in self:
            raise ValueError(f"frame {frame!r} was there before")
        last = self._stamp if record.sequence == self._sequence else -math.inf
        if not math.isnan(stamp) and not last <= stamp < math.inf:
            raise ValueError(f"frame {frame!r}: expected a stamp from {last} on, got {stamp}")

    def _look(self, frame: str, swept: Floats, others: Mapping[str, Floats]) -> LoopResult:
        """Takes in the next frame, and gives its result."""
        old = max(0, len(self) - self.config.exclude)
        self._extend(len(self) - min(RECENT, self.config.exclude))
        compared, empty = ~self._memory.empty, not swept[len(swept) // 2].any()
        if np.count_nonzero(compared[:old]) < 2:
            if empty:
                return LoopResult(frame, Reason.EMPTY_FRAME)
            known = compared.any()
            return LoopResult(frame, Reason.TOO_RECENT if known else Reason.NO_CANDIDATE)
        if empty:
            self._filter.step(torch.full((len(self._filter),), -torch.inf))
            return LoopResult(frame, Reason.EMPTY_FRAME)
        scores = self._scores(swept, others, old)
        told = self._evidence(scores, moments(scores[:old]))
        self._filter.update(self._filter.in_cells(told[: len(self._filter)]))
        rows = self._filter.rows()
        candidate = int(rows[:old].argmax())
        around = slice(max(0, candidate - NEAR), min(candidate + NEAR + 1, old))
        probability = min(1.0, float(rows[around].sum()))
        reason = self._reason(probability, float(rows[:old].sum()), float(rows[old:].sum()))
        ahead = self._ahead(candidate, around, rows) if reason is Reason.ACCEPTED else None
        name, score = self._memory.frames[candidate], float(scores[candidate])
        return LoopResult(frame, reason, name, score, probability, ahead)

    def _scores(self, swept: Floats, others: Mapping[str, Floats], old: int) -> Tensor:
        """``(N,)`` scores of a frame by all methods, scaled by those of the old frames."""
        own = torch.from_numpy(self._memory.scores(swept))
        if not others:
            return own
        scores = [own, *(torch.from_numpy(self._others[n].scores(v)) for n, v in others.items())]
        for place, one in enumerate(scores):
            self._leads[place] += max(0.0, z_lead(one[:old]))
        return fused(scores, weights_of(self._leads), old)

    def _evidence(self, scores: Tensor, spread: tuple[float, float]) -> Tensor:
        """``(N,)``, see `motion.likelihoods`; frames of this sequence have their own level."""
        mean, deviation = spread
        before = len(self) - max(1, self.config.exclude // STRIDE)
        if self._began <= before and deviation > MIN_SPREAD:
            z = (float(nearness(scores[before])) - mean) / deviation
            if math.isfinite(z):
                self._neighbours.append(z)
        known = self._neighbours.values
        level = LIKENESS * float(np.quantile(known, 0.25)) if len(known) else 0.0
        own = replace(MOTION, weight=WEIGHT, level=max(MOTION.level, level))
        others, same = scores[: self._began], scores[self._began :]
        return torch.cat((likelihoods(others, MOTION, spread), likelihoods(same, own, spread)))

    def _extend(self, rows: int) -> None:
        """Adds frames to the filter, up to a number of rows."""
        fresh = self._memory.frames[len(self._filter) : max(0, rows)]
        self._filter.extend([frame.rpartition("/")[0] for frame in fresh])

    def _reason(self, probability: float, old: float, recent: float) -> Reason:
        threshold = self.config.threshold
        if probability >= threshold:
            return Reason.ACCEPTED
        if recent > max(old, 1 - old - recent):
            return Reason.TOO_RECENT
        return Reason.AMBIGUOUS if old >= threshold else Reason.BELOW_THRESHOLD

    def _ahead(self, candidate: int, around: slice, rows: Tensor) -> float | None:
        """How far the frame stands ahead of its candidate; see `LoopResult`."""
        sequence = self._memory.frames[candidate].rpartition("/")[0]
        near = [
            row
            for row in range(around.start, around.stop)
            if self._memory.frames[row].rpartition("/")[0] == sequence
        ]
        places = self._memory.poses[near, :2]
        if np.isnan(places).any():
            return None
        along = np.cumsum([0.0, *np.hypot(*np.diff(places, axis=0).T)])
        weights = rows[near].double().numpy()
        return float(weights @ (along - along[near.index(candidate)]) / weights.sum())


def _pose(pose: Sequence[float] | None, frame: str) -> tuple[float, float, float]:
    if pose is None:
        return math.nan, math.nan, math.nan
    numbers = [] if isinstance(pose, str) else [float(number) for number in pose]
    if len(numbers) not in (2, 3) or any(map(math.isinf, numbers)):
        raise ValueError(f"frame {frame!r}: expected a pose of finite x, y, heading, got {pose!r}")
    x, y, heading = (*numbers, math.nan)[:3]
    return x, y, heading
