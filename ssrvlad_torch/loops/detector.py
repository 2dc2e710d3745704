"""Loop closures in a live stream: has this place been seen before?"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..database.database import Database
from ..database.frames import FrameRecord
from ..datasets.label_files import digest
from ..descriptor import SSRVLAD
from .config import LoopConfig
from .judge import LoopJudge
from .log import LoopLog, read_state, write_state
from .memory import Floats, OnlineMemory, Snapshot
from .result import LoopResult
from .sighting import GeometricCheck, KeyPoints, PoseGate, Sighting

STATE_FILE = "loops.npz"
"""Stands beside the parts of the database; see `LoopDetector.save`."""


class LoopDetector:
    """Tells for each frame of a stream whether its place was seen before.

    A frame is compared, by itself, with the earlier frames after Eq. 3 (queries are never summed),
    and goes into the memory. The search is exact. The best candidate must pass the checks that
    `LoopResult` lists.

    One thread updates. Others may read `snapshot` meanwhile, and another may `save`. Until it is
    saved, a frame is held twice, summed for the map and raw for the checkpoint.

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
        self._judge = LoopJudge(self.config, self._log, pose_gate, geometry)
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
        height, width, content = labels
        seconds = math.nan if stamp is None else stamp
        record = FrameRecord(sequence, name, *place, seconds, "", content, height, width)
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
            result, found = self._judge.judge(here, vector, self.snapshot)
            self._log.append(here)
            self._memory.append(here.frame, vector)
            self._unsaved.append((record, vector))
            if found is not None:
                confirmed = self.config.confirmations if result.accepted else 0
                self._log.conclude(found.candidate, found.own_strength, found.moments, confirmed)
        return result

    def end_sequence(self) -> None:
        """Takes the last ``temporal`` frames into the map: none will follow in their sequence.

        A checkpoint does not hold this: a detector that is loaded waits for more of its last
        sequence.
        """
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
            write_state(Path(database.path) / STATE_FILE, state)
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
        frames, sorted_frames = list(database.known()), database.load()
        row = {frame: number for number, frame in enumerate(sorted_frames.frames)}
        order = [row[frame] for frame in frames]
        descriptors = sorted_frames.descriptors.numpy()[order]
        reach = detector.config.temporal
        detector._memory = OnlineMemory.of_frames(frames, descriptors, reach)
        state = read_state(Path(database.path) / STATE_FILE)
        try:
            detector._log.restore(frames, sorted_frames.poses[order], state)
        except ValueError as error:
            raise ValueError(f"{Path(database.path) / STATE_FILE} does not fit: {error}") from error
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


def _pose(pose: Sequence[float] | None, frame: str) -> tuple[float, float, float]:
    if pose is None:
        return math.nan, math.nan, math.nan
    if len(pose) not in (2, 3):
        raise ValueError(f"frame {frame!r} has a pose of {len(pose)} numbers; wanted x, y, heading")
    x, y, *heading = map(float, pose)
    return x, y, heading[0] if heading else math.nan
