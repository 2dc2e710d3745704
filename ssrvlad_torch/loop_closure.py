"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .database import Database, FrameRecord
from .datasets.label_files import digest
from .descriptor import SSRVLAD
from .loop_config import LoopConfig
from .loop_log import LoopLog, read_state, write_state
from .online_memory import Floats, OnlineMemory, Snapshot

STATE_FILE = "loops.npz"
"""Stands beside the parts of the database; see `LoopDetector.save`."""

_LEAST_SPREAD = 1e-6
_ROUNDING = 1e-6
"""Cosines of 480 float32 products are no more exact than this."""

KeyPoints = npt.NDArray[np.int16]
"""``(P, 3)``: category, row and column of each key-point on the working grid."""


class Reason(StrEnum):
    """Why a frame closes a loop or does not; see `LoopResult`."""

    ACCEPTED = "accepted"
    EMPTY_FRAME = "empty_frame"
    NO_CANDIDATE = "no_candidate"
    TOO_RECENT = "too_recent"
    IMPLAUSIBLE = "implausible"
    BELOW_THRESHOLD = "below_threshold"
    AMBIGUOUS = "ambiguous"
    INCONSISTENT = "inconsistent"
    DISPROVED = "disproved"


class LoopResult(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: its id.
        reason: ``accepted`` if all checks are passed, else the first that is not:

            - ``empty_frame``: its descriptor is zero.
            - ``no_candidate``: no frame came before, or none but empty ones.
            - ``too_recent``: all earlier frames are too recent to be candidates.
            - ``implausible``: the pose gate lets no candidate pass.
            - ``below_threshold``: the best candidate is not alike enough.
            - ``too_recent`` again, with a candidate: its place has not been left since.
            - ``ambiguous``: another place is nearly as much alike.
            - ``inconsistent``: the candidates of the frames before were elsewhere.
            - ``disproved``: the geometric check said no.
        candidate: id of the best candidate, ``None`` if there is none.
        score: its cosine, or ``None``.
        strength: what was held against the threshold, see `LoopConfig`, or ``None``.
    """

    frame: str
    reason: Reason
    candidate: str | None = None
    score: float | None = None
    strength: float | None = None

    @property
    def accepted(self) -> bool:
        """Whether the frame closes a loop."""
        return self.reason is Reason.ACCEPTED


class Sighting(NamedTuple):
    """What a geometric check is told of a frame.

    Attributes:
        frame: its id.
        pose: ``(3,)`` x and y in metres and heading in radians, NaN where unknown.
        stamp: seconds, -inf where unknown.
        keypoints: ``(P, 3)`` int16, category, row and column on the working grid; ``None`` for a
            frame that came as a descriptor or from a database.
    """

    frame: str
    pose: npt.NDArray[np.float64]
    stamp: float
    keypoints: KeyPoints | None


PoseGate = Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.bool_]]
"""``gate(pose, poses)``: a frame's ``(3,)`` pose and the ``(N, 3)`` poses of earlier ones, as in
`Sighting` -> ``(N,)`` bool, whether each can be the same place."""

GeometricCheck = Callable[[Sighting, Sighting], bool]
"""``check(here, there)``: whether a frame and its candidate can be the same place."""


class LoopDetector:
    """Tells for each frame of a stream whether its place was seen before.

    A frame is compared, by itself, with the earlier frames after Eq. 3 (queries are never summed),
    and goes into the memory. The search is exact. The best candidate must pass the checks that
    `LoopResult` lists.

    One thread updates. Others may read `snapshot` meanwhile, and another may `save`.

    Args:
        config: the settings; without, the defaults.
        head: describes label maps; descriptors that are given must be of its settings. Without,
            the preset ``default``.
        pose_gate: says which candidates are plausible by their poses; every frame needs one then.
        geometry: has the last word on the best candidate, by key-points.

    Example:
        >>> detector = LoopDetector(head=SSRVLAD())
        >>> detector.update(torch.full((60, 80), 7), "drive/000000").reason.value
        'no_candidate'
    """

    def __init__(
        self,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
        pose_gate: PoseGate | None = None,
        geometry: GeometricCheck | None = None,
    ) -> None:
        self.config = config or LoopConfig()
        self.head = head or SSRVLAD()
        self._pose_gate, self._geometry = pose_gate, geometry
        self._memory = OnlineMemory(self.head.config.length, self.config.temporal)
        self._log = LoopLog()
        self._keypoints: dict[int, KeyPoints | None] = {}
        self._unsaved: list[tuple[FrameRecord, Floats]] = []
        self._updating, self._saving = threading.Lock(), threading.Lock()

    def __len__(self) -> int:
        return len(self._log)

    def __contains__(self, frame: object) -> bool:
        return frame in self._log

    @property
    def frames(self) -> list[str]:
        """Ids of all frames in order."""
        return self._log.frames

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        """``(N, 3)`` float64, a copy: x and y in metres, heading in radians, NaN where unknown."""
        return self._log.poses.copy()

    @property
    def snapshot(self) -> Snapshot:
        """The map of now, for any thread; it lacks the last ``temporal`` frames."""
        return self._memory.snapshot

    def update(
        self,
        view: Tensor | npt.NDArray[Any],
        frame_id: str,
        stamp: float | None = None,
        pose: Sequence[float] | None = None,
    ) -> LoopResult:
        """Looks for the place of the next frame among the earlier ones, then remembers it.

        Args:
            view: ``(H, W)`` integer label map, ``(C, H, W)`` class scores, or the frame's ``(D,)``
                descriptor.
            frame_id: ``<sequence>/<name>``; another sequence than the last frame's ends that one.
            stamp: seconds, not less than that of the frame before.
            pose: x and y in metres, and heading in radians if it is known.

        Raises:
            ValueError: the frame cannot be described, its id is of another form or was there
                before, or a stamp or pose is wrong, or missing where it is needed. The detector
                is as it was.
        """
        sequence, _, name = frame_id.rpartition("/")
        if not (sequence and name):
            raise ValueError(f"a frame's id must be <sequence>/<name>, got {frame_id!r}")
        place = _pose(pose, frame_id)
        descriptor, keypoints, labels = self._describe(torch.as_tensor(view))
        record = FrameRecord(sequence, name, self.head.config.labels_as, *labels, *place)
        return self.observe(record, descriptor, stamp, keypoints)

    def observe(
        self,
        record: FrameRecord,
        descriptor: Tensor,
        stamp: float | None = None,
        keypoints: KeyPoints | None = None,
    ) -> LoopResult:
        """As `update`, for a frame that was encoded before, with what a database keeps of it."""
        vector = self._vector(descriptor, record.frame)
        with self._updating:
            here = self._sighting(record, stamp, keypoints)
            found = self._find(here, vector)
            if isinstance(found, Reason):
                result = LoopResult(here.frame, found)
            else:
                result = self._judge(found)
            self._remember(here, vector)
            self._unsaved.append((record, vector))
            if isinstance(found, _Found):
                confirmed = self.config.confirmations if result.accepted else 0
                self._log.conclude(found.candidate, found.own_strength, found.moments, confirmed)
        return result

    def end_sequence(self) -> None:
        """Takes the last ``temporal`` frames into the map: none will follow in their sequence."""
        with self._updating:
            self._memory.end_sequence()

    def save(self, database: Database) -> None:
        """Writes a checkpoint: adds to a database the frames that came since the last one.

        The database gets raw descriptors, like any other. A file beside its parts, `STATE_FILE`,
        holds the stamps and what was found. It is written first, and may know of more frames than
        the database: a crash at any moment leaves this checkpoint or the last. Another thread may
        update meanwhile.

        Args:
            database: the one that was loaded, or saved to before; at first an empty one.

        Raises:
            ValueError: the database has another fingerprint, or other frames than those saved.
            OSError: the disk refused; the last checkpoint stands.
        """
        with self._saving:
            with self._updating:
                fresh, state = self._unsaved.copy(), self._log.state()
            database.require(self.head.config)
            saved = len(state["stamp"]) - len(fresh)
            if len(database) != saved:
                raise ValueError(
                    f"{database.path} holds {len(database)} frames; {saved} of this stream were "
                    "saved"
                )
            write_state(database.path / STATE_FILE, state)
            descriptors = [torch.from_numpy(vector) for _, vector in fresh]
            if fresh:
                database.append([record for record, _ in fresh], torch.stack(descriptors))
            with self._updating:
                del self._unsaved[: len(fresh)]

    @classmethod
    def load(
        cls,
        database: Database,
        config: LoopConfig | None = None,
        head: SSRVLAD | None = None,
        pose_gate: PoseGate | None = None,
        geometry: GeometricCheck | None = None,
    ) -> LoopDetector:
        """The detector at its last checkpoint; with equal settings it goes on as if never stopped.

        Any database will do: one that no detector wrote is a map of places seen long ago. Frames
        come in the order in which they were added.

        Args:
            database: raw descriptors.
            config, pose_gate, geometry: as for `LoopDetector`.
            head: its settings must have the database's fingerprint; without, the database's.

        Raises:
            ValueError: the fingerprints differ, or a file is damaged; the message names it.
        """
        head = head or SSRVLAD(database.config)
        database.require(head.config)
        detector = cls(config, head, pose_gate, geometry)
        frames, sorted_frames = _in_order_of_addition(database), database.load()
        row = {frame: number for number, frame in enumerate(sorted_frames.frames)}
        order = [row[frame] for frame in frames]
        descriptors = sorted_frames.descriptors.numpy()[order]
        reach = detector.config.temporal
        detector._memory = OnlineMemory.of_frames(frames, descriptors, reach)
        state = read_state(database.path / STATE_FILE)
        try:
            detector._log.restore(frames, sorted_frames.poses[order], state)
        except ValueError as error:
            raise ValueError(f"{database.path / STATE_FILE} does not fit: {error}") from error
        return detector

    def _describe(self, view: Tensor) -> tuple[Tensor, KeyPoints | None, tuple[int, int, str]]:
        """Descriptor, key-points if they are wanted, and the label map's size and digest."""
        if view.ndim == 1:
            return view, None, (0, 0, "")
        keypoints = None
        if self._geometry is None:
            descriptor = self.head(view[None])[0]
        else:
            seen = self.head.explain(view[None])
            descriptor = seen.descriptor[0]
            keypoints = seen.keypoints[0].nonzero().cpu().numpy().astype(np.int16)
        labels = (view.argmax(0) if view.ndim == 3 else view).cpu().numpy()
        return descriptor, keypoints, (*labels.shape, digest(labels))

    def _vector(self, descriptor: Tensor, frame: str) -> Floats:
        vector = descriptor.detach().cpu().float().numpy()
        if vector.shape != (self.head.config.length,):
            raise ValueError(
                f"frame {frame!r} has a descriptor of shape {vector.shape}; "
                f"wanted ({self.head.config.length},)"
            )
        if not np.isfinite(vector).all():
            raise ValueError(f"frame {frame!r} has a descriptor with values that are not finite")
        return vector.copy()

    def _sighting(
        self, record: FrameRecord, stamp: float | None, keypoints: KeyPoints | None
    ) -> Sighting:
        """The frame, if it may be the next one."""
        frame, pose = record.frame, np.array([record.x, record.y, record.heading])
        last = self._log.stamps[-1] if len(self) else -math.inf
        if frame in self:
            raise ValueError(f"frame {frame!r} was there before")
        if stamp is not None and not last <= stamp < math.inf:
            raise ValueError(f"frame {frame!r} has stamp {stamp}; wanted one from {last} on")
        if stamp is None and self.config.exclude_seconds:
            raise ValueError(f"frame {frame!r} has no stamp, which exclude_seconds wants")
        if self._pose_gate and not np.isfinite(pose[:2]).all():
            raise ValueError(f"frame {frame!r} has no pose, which the pose gate wants")
        return Sighting(frame, pose, -math.inf if stamp is None else stamp, keypoints)

    def _find(self, here: Sighting, vector: Floats) -> _Found | Reason:
        """The best candidate, or why there is none."""
        if not vector.any():
            return Reason.EMPTY_FRAME
        if not len(self):
            return Reason.NO_CANDIDATE
        scores = self.snapshot.scores(vector / np.linalg.norm(vector))
        old = self._old(here, len(scores))
        compared = scores[:old][~self.snapshot.empty[:old]]
        if not len(compared):
            return Reason.NO_CANDIDATE if old else Reason.TOO_RECENT
        self._close_gate(here, scores)
        candidate = int(scores[:old].argmax())
        if scores[candidate] == -np.inf:
            return Reason.IMPLAUSIBLE
        return self._weigh(here, scores, candidate, _moments(_nearness(compared)))

    def _weigh(
        self, here: Sighting, scores: Floats, candidate: int, moments: tuple[float, float]
    ) -> _Found:
        """The best candidate with its strength."""
        strength, cutoff = float(scores[candidate]), self.config.threshold
        if self.config.relative:
            mean, spread = self._spread(moments)
            strength = (float(_nearness(scores[candidate])) - mean) / spread
            cutoff = 1 - math.exp(-mean - self.config.threshold * spread)
        earlier = self._log.strengths(self.config.confirmations - 1)
        shared = float(np.nanmean(np.append(earlier, strength)))
        return _Found(here, candidate, scores, strength, shared, cutoff, moments)

    def _old(self, here: Sighting, mapped: int) -> int:
        """How many rows of the map are not too recent to be candidates."""
        rows = min(mapped, len(self) - self.config.exclude)
        if self.config.exclude_seconds:
            latest = here.stamp - self.config.exclude_seconds
            rows = min(rows, int(np.searchsorted(self._log.stamps, latest, side="right")))
        return max(0, rows)

    def _close_gate(self, here: Sighting, scores: Floats) -> None:
        if self._pose_gate is None:
            return
        plausible = np.asarray(self._pose_gate(here.pose, self._log.poses[: len(scores)]))
        if plausible.shape != scores.shape or plausible.dtype != np.bool_:
            raise ValueError(
                f"the pose gate gave {plausible.shape} {plausible.dtype} for {len(scores)} poses; "
                "wanted a bool for each"
            )
        scores[~plausible] = -np.inf

    def _spread(self, moments: tuple[float, float]) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of the candidates of the last frames."""
        earlier = self._log.moments(self.config.relative - 1)
        mean, square = np.nanmean(np.concatenate((earlier, [moments])), axis=0).tolist()
        return mean, math.sqrt(max(square - mean * mean, _LEAST_SPREAD**2))

    def _judge(self, found: _Found) -> LoopResult:
        checks: tuple[tuple[Reason, Callable[[_Found], bool]], ...] = (
            (Reason.BELOW_THRESHOLD, lambda found: found.strength < self.config.threshold),
            (Reason.TOO_RECENT, lambda found: found.candidate >= self._present(found)),
            (Reason.AMBIGUOUS, self._has_rival),
            (Reason.INCONSISTENT, self._is_unconfirmed),
            (Reason.DISPROVED, self._is_disproved),
        )
        reason = next((reason for reason, holds in checks if holds(found)), Reason.ACCEPTED)
        candidate = self.snapshot.ids[found.candidate]
        return LoopResult(found.here.frame, reason, candidate, found.score, found.strength)

    def _present(self, found: _Found) -> int:
        """First row of the place that has not been left since."""
        cutoff = min(found.cutoff, found.score)
        alike = np.append(np.flatnonzero(found.scores >= cutoff), len(self))
        left = np.diff(alike) - 1 > self.config.neighbourhood + self.config.temporal
        return int(alike[np.flatnonzero(left)[-1] + 1 if left.any() else 0])

    def _has_rival(self, found: _Found) -> bool:
        """Whether a frame that shows neither the candidate's place nor the present one is too near.

        A frame that closed a loop shows the place of its candidate, so that an earlier visit to
        the candidate's place is no rival.
        """
        if self.config.ratio == 1:
            return False
        others = found.scores.copy()
        reach = self.config.neighbourhood
        same = self._log.same_place(found.candidate, reach)
        others[same[same < len(others)]] = -np.inf
        others[max(0, self._present(found) - reach) :] = -np.inf
        return bool(1 - found.score > self.config.ratio**2 * (1 - others.max()))

    def _is_unconfirmed(self, found: _Found) -> bool:
        """Whether the best candidates of the last frames do not stay together."""
        earlier = self.config.confirmations - 1
        if len(self) - earlier < self._log.start_of_sequence(found.here.frame):
            return True
        candidates = np.append(self._log.candidates(earlier), found.candidate)
        steps = np.abs(np.diff(candidates))
        return bool((candidates < 0).any() or (steps > self.config.window).any())

    def _is_disproved(self, found: _Found) -> bool:
        if self._geometry is None:
            return False
        row = found.candidate
        pose, stamp = self._log.poses[row].copy(), float(self._log.stamps[row])
        there = Sighting(self.snapshot.ids[row], pose, stamp, self._keypoints.get(row))
        return not self._geometry(found.here, there)

    def _remember(self, here: Sighting, vector: Floats) -> None:
        if here.keypoints is not None:
            self._keypoints[len(self)] = here.keypoints
        self._log.append(here.frame, here.pose, here.stamp)
        self._memory.append(here.frame, vector)


class _Found(NamedTuple):
    """The best candidate of a frame, and what it is judged by.

    Attributes:
        here: the frame.
        candidate: row of the candidate.
        scores: ``(rows of the map,)`` float32, -inf for empty frames and where the pose gate is
            shut.
        own_strength: strength of the candidate.
        strength: what is held against the threshold.
        cutoff: the threshold as a cosine.
        moments: mean, and mean square, of the nearness of all candidates.
    """

    here: Sighting
    candidate: int
    scores: Floats
    own_strength: float
    strength: float
    cutoff: float
    moments: tuple[float, float]

    @property
    def score(self) -> float:
        return float(self.scores[self.candidate])


def _nearness(scores: Floats | np.float32) -> Floats:
    """How near candidates are: less the logarithm of half their squared Euclidean distance."""
    return -np.log(np.maximum(1 - scores, np.float32(_ROUNDING)))


def _moments(values: Floats) -> tuple[float, float]:
    exact = values.astype(np.float64)
    return float(exact.mean()), float(exact @ exact) / len(exact)


def _in_order_of_addition(database: Database) -> list[str]:
    columns = database.table(["sequence", "name"]).to_pydict()
    rows = zip(columns["sequence"], columns["name"], strict=True)
    return [f"{sequence}/{name}" for sequence, name in rows]


def _pose(pose: Sequence[float] | None, frame: str) -> tuple[float, float, float]:
    if pose is None:
        return math.nan, math.nan, math.nan
    if len(pose) not in (2, 3):
        raise ValueError(f"frame {frame!r} has a pose of {len(pose)} numbers; wanted x, y, heading")
    x, y, *heading = map(float, pose)
    return x, y, heading[0] if heading else math.nan
