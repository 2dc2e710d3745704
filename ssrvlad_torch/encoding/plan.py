"""The plan of an encoding run: which frames must be encoded, and why."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..database.database import Database
from ..database.frames import FrameRecord, folder_of
from ..database.metadata import Origin
from ..database.rows import KnownFrames
from ..datasets.frame_file import FrameFile
from ..datasets.names import is_same, see_sequences

NEW = "new"
LABEL_SPACE, SEGMENTER = "label space changed", "segmenter changed"
MOVED, FILE, TOUCHED = "file moved", "file changed", "file touched, the same label map"
POSE = "pose changed"


@dataclass(frozen=True)
class Plan:
    """The frames that an encoding run must encode, and why.

    A row is up to date if its frame has the same source (by its signature), label space, segmenter
    and pose. All other frames are encoded.

    Attributes:
        files: of frames to encode.
        reasons: why each of them, by the frame's id.
        digests: of the label maps of those whose row may turn out the same, by the frame's id.
        already_there: number of frames that are up to date.
        gone: ids of frames of the same folders that have no file.
    """

    files: list[FrameFile]
    reasons: dict[str, str]
    digests: dict[str, str]
    already_there: int
    gone: list[str]

    @classmethod
    def of(cls, files: Sequence[FrameFile], database: Database, origin: Origin) -> Plan:
        """The plan for files of label maps of an origin, or that it makes label maps of. A sequence
        of the database that is of another folder is a ValueError."""
        known, origins = database.known(), database.origins
        there = {name for name, entry in origins.items() if _reason(origin, entry) is None}
        check_folders(files, known)
        todo, reasons, digests = list[FrameFile](), dict[str, str](), dict[str, str]()
        for file in files:
            record = known.get(file.frame)
            reason: str | None = NEW
            if record is not None:
                reason = _why_anew(file, record)
                if record.origin not in there:
                    reason = _reason(origin, origins.get(record.origin)) or reason
            if reason is not None:
                todo.append(file)
                reasons[file.frame] = reason
                if record is not None:
                    digests[file.frame] = record.digest
        return cls(todo, reasons, digests, len(files) - len(todo), list(_gone(files, known)))

    def reason(self, record: FrameRecord) -> str:
        """Why a frame was encoded, now that its label map is known."""
        reason = self.reasons[record.frame]
        same = reason == FILE and self.digests[record.frame] == record.digest
        return TOUCHED if same else reason


def _why_anew(file: FrameFile, record: FrameRecord) -> str | None:
    """Why a frame with a row of the same origin must be encoded; ``None`` if not."""
    signature = file.signature()
    if record.signature != signature:
        state = record.signature.rpartition("|")[2]
        return FILE if state != signature.rpartition("|")[2] else MOVED
    there = (record.x, record.y, record.heading)
    same = math.isnan(file.pose.x) or np.array_equal(file.pose, there, equal_nan=True)
    return None if same else POSE


def _reason(now: Origin, then: Origin | None) -> str | None:
    """Why label maps of one origin do not replace those of another."""
    if then is None or then.label_space is None or now.label_space is None:
        return LABEL_SPACE
    if then.label_space.digest != now.label_space.digest:
        return LABEL_SPACE
    return SEGMENTER if then.segmenter != now.segmenter else None


def check_folders(files: Sequence[FrameFile], known: KnownFrames) -> None:
    """Refuses to merge or overwrite frames of different folders; a sequence that the user named may
    have frames of several.

    Raises:
        ValueError: files have the name of a sequence or of a frame of another folder.
    """
    ours = {(file.folder, file.sequence) for file in files if not file.named}
    see_sequences(ours, known.folders())
    for file in files:
        if file.named and (record := known.get(file.frame)):
            check_folder(file, record)


def check_folder(file: FrameFile, record: FrameRecord) -> None:
    """Refuses a file of another folder than that of a frame of its name.

    Raises:
        ValueError: it is, and the folder of the frame is still there.
    """
    folder = record.folder
    if folder and not is_same(folder, file.folder) and Path(folder).exists():
        raise ValueError(
            f"frame {file.frame!r} of the database is of {folder}, not of {file.folder}: give "
            "another name with --sequence"
        )


def _gone(files: Sequence[FrameFile], known: KnownFrames) -> Iterator[str]:
    """Frames of the folders of files, without a file."""
    there, folders = {file.frame for file in files}, {file.folder for file in files}
    for frame, signature in zip(known, known.column("signature"), strict=True):
        if folder_of(signature) in folders and frame not in there:
            yield frame
