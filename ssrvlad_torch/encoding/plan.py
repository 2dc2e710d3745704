"""What an encoding run changes: the plan of which frames to encode, and why; and its commits."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..database.database import Database
from ..database.frames import FrameRecord
from ..database.rows import Origin, StoredRecords, folder_of, folders_of
from ..datasets.frame_file import FrameFile
from ..datasets.names import check_sequences, is_same_folder
from ..datasets.poses import Pose
from .results import Encoded, EncodeOptions, Skipped, Summary

NEW = "new"
LABEL_SPACE, SEGMENTER = "label space changed", "segmenter changed"
MOVED, FILE, TOUCHED = "file moved", "file changed", "file touched, the same label map"
POSE = "pose changed"


@dataclass(frozen=True)
class Plan:
    """The frames that an encoding run must encode, and why. A row of the database is up to date if
    its frame has the same file (by its signature), label space, segmenter and pose. A frame keeps
    its pose where no source of poses is given.

    Attributes:
        files, reasons, digests: files of the frames to encode; by frame id, why, and of those to
            encode again the digest of the label map in the database.
        gone: ids of frames in the database from the same folders, whose file does not exist; none
            of a folder with a bag, video or ``.npy`` file that cannot be read.
        refused: frames whose names are no ids.
    """

    files: list[FrameFile]
    reasons: dict[str, str]
    digests: dict[str, str]
    already_there: int
    gone: list[str]
    refused: list[Skipped]

    @classmethod
    def of(cls, files: Sequence[FrameFile], database: Database, origin: Origin) -> Plan:
        """The plan for files whose label maps have an origin; errors as for `check_folders`, or a
        file is a frame of another sequence."""
        records = database.known()
        check_folders(files, records)
        _check_names(files, records)
        changes = {key: _why_origin(stored, origin) for key, stored in database.origins.items()}
        todo, reasons, digests = list[FrameFile](), dict[str, str](), dict[str, str]()
        refused = list[Skipped]()
        for file in files:
            record = records.get(file.frame)
            if record is None and any(n != n.strip() for n in (file.sequence, file.name)):
                blank = f"{file.location}: its name, or its folder's, begins or ends in a blank"
                refused.append(Skipped(file.frame, blank))
            elif record is None:
                reasons[file.frame] = NEW
                todo.append(file)
            elif reason := changes.get(record.origin, LABEL_SPACE) or _why_file(file, record):
                reasons[file.frame], digests[file.frame] = reason, record.digest
                todo.append(file if file.has_pose_source else replace(file, pose=_pose_of(record)))
        unread = {file.folder for file in files if file.problem or file.is_torn}
        present, folders = {f.frame for f in files}, {f.folder for f in files} - unread
        rows = zip(*(records.table[n].to_pylist() for n in ("frame", "signature")), strict=True)
        gone = [f for f, s in rows if folder_of(s) in folders and f not in present]
        there = len(files) - len(todo) - len(refused)
        return cls(todo, reasons, digests, there, gone, refused)

    def reason(self, record: FrameRecord) -> str:
        """Why a frame was encoded, given its new record."""
        reason = self.reasons[record.frame]
        same = reason == FILE and self.digests[record.frame] == record.digest
        return TOUCHED if same else reason


def _why_origin(stored: Origin, origin: Origin) -> str:
    """Why frames of a stored origin must be encoded again with another; empty if they fit it."""
    digests = [o.label_space and o.label_space.digest for o in (stored, origin)]
    if stored.label_space is None or digests[0] != digests[1]:
        return LABEL_SPACE
    return SEGMENTER if stored.segmenter != origin.segmenter else ""


def _why_file(file: FrameFile, record: FrameRecord) -> str:
    """Why a frame must be encoded again for its file or pose; empty if its record fits."""
    signature = file.signature()
    if record.signature != signature:
        state = record.signature.rpartition("|")[2]
        return FILE if state != signature.rpartition("|")[2] else MOVED
    same = np.array_equal(file.pose, _pose_of(record), equal_nan=True)
    return POSE if file.has_pose_source and not same else ""


def _pose_of(record: FrameRecord) -> Pose:
    return Pose(record.x, record.y, record.heading)


def check_folders(files: Sequence[FrameFile], records: StoredRecords) -> None:
    """Raises a ValueError for a file with the sequence, or the frame id, of another folder, whose
    frames it would overwrite or join. A sequence that the user named may have several folders."""
    folders = {(file.folder, file.sequence) for file in files if not file.is_named}
    check_sequences(folders, folders_of(records.table))
    for file in files:
        if file.is_named and (record := records.get(file.frame)):
            check_folder(file, record)


def check_folder(file: FrameFile, record: FrameRecord) -> None:
    """Refuses a file in another folder than its stored frame, if that folder still exists."""
    folder = folder_of(record.signature)
    if folder and not is_same_folder(folder, file.folder) and Path(folder).exists():
        raise ValueError(
            f"frame {file.frame!r} of the database is of {folder}, not of {file.folder}: give "
            "another name with --sequence"
        )


def _check_names(files: Sequence[FrameFile], records: StoredRecords) -> None:
    """Requires that no file of a sequence that the user named is a frame of another sequence."""
    named = [file for file in files if file.is_named]
    stored = folders_of(records.table) if named else ()
    sequences = {
        (folder, name): [n for f, n in stored if n != name and f and is_same_folder(f, folder)]
        for folder, name in {(file.folder, file.sequence) for file in named}
    }
    for file in named:
        for sequence in sequences[file.folder, file.sequence]:
            if (frame := f"{sequence}/{file.name}") in records:
                raise ValueError(
                    f"{file.location} is frame {frame!r} of the database: expected --sequence "
                    f"{sequence}, got {file.sequence}"
                )


COMMIT_ROWS, COMMIT_SECONDS = 8192, 10.0
"""A commit is made after this number of frames or this time."""


class Writer(AbstractContextManager["Writer"]):
    """Collects encoded frames and commits them to a database; the last ones when it is closed."""

    def __init__(self, database: Database, plan: Plan, options: EncodeOptions) -> None:
        self.summary = Summary(already_there=plan.already_there)
        self._database, self._plan, self._options = database, plan, options
        self._waiting = list[Encoded]()
        self._due = time.monotonic() + COMMIT_SECONDS
        for frame in plan.refused:
            self.add(frame)

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Commits the last frames; without an error, removes or reports those that are gone."""
        self.commit()
        if kind is None and self._options.prune:
            self._database.remove(self._plan.gone)
            self.summary.pruned = len(self._plan.gone)
        elif kind is None and self._options.complete:
            self.summary.gone = self._plan.gone

    def add(self, result: Encoded | Skipped) -> None:
        """Adds the result of a frame."""
        if isinstance(result, Skipped):
            self.summary.skipped.append(result)
            self._options.skipped(result)
        else:
            self._waiting.append(result)
            if len(self._waiting) >= COMMIT_ROWS or time.monotonic() > self._due:
                self.commit()
        self._options.progress(1)

    def commit(self) -> None:
        """Commits the waiting frames."""
        frames, self._waiting = self._waiting, []
        if frames:
            check = partial(check_folders, self._plan.files)
            descriptors = {
                name: np.stack([frame.descriptors[name] for frame in frames])
                for name in frames[0].descriptors
            }
            self._database.merge([frame.record for frame in frames], descriptors, check)
            reasons = [self._plan.reason(frame.record) for frame in frames]
            self.summary.encoded += reasons.count(NEW)
            self.summary.anew.update(reason for reason in reasons if reason != NEW)
            self.summary.empty += sum(frame.is_empty for frame in frames)
        self._due = time.monotonic() + COMMIT_SECONDS
