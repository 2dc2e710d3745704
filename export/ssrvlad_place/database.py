"""A database in NumPy's form, as `ssrvlad db export --format npy` writes it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.lib.format import open_memmap

from ssrvlad_torch.files import naming, replacing
from ssrvlad_torch.native.map import Decision, DescriptorMap
from ssrvlad_torch.native.tracker import DescriptorTracker
from ssrvlad_torch.recognition.sequences import MIN_FRAMES

from .model import FEATURES, HOG, LABEL_SHAPES, TRUST, Description
from .output import note

Array = npt.NDArray[Any]

AXES = {LABEL_SHAPES: 2, FEATURES: 4, HOG: 2}
"""Of the array of each channel."""
POSE = "x", "y", "heading"


class Answer(NamedTuple):
    """The answer to one query: candidates, best first, with their scores; what these are,
    ``"cosine"``, ``"fused score"`` or ``"probability"``; the probability that the first candidate
    is right; whether the mean of the sequence is known, see `Database.track`; and of each candidate
    ``x`` and ``y`` in metres and the ``heading`` in radians, NaN where unknown."""

    candidates: list[tuple[str, float]]
    score_is: str
    confidence: float
    settled: bool
    poses: list[dict[str, float]]


class Database:
    """Descriptors of reference frames in a `.npy` file, and the frames' ids.

    ``FILE.frames.txt`` holds the ids, one a line, ``FILE.fingerprint.txt`` the fingerprint, and
    ``FILE.features.npy`` and ``FILE.hog.npy`` the other channels, with fingerprints of their own;
    ``FILE.poses.npy``, if it exists, x, y and heading of each frame.

    Args:
        path: FILE.
        fingerprints: of the channels of the model, by name; see `Model.fingerprints`.

    Attributes:
        channels: the arrays of the channels that both have, by name.

    Raises:
        ValueError: the files do not fit each other or the model.
        OSError: a file cannot be read.
    """

    def __init__(self, path: Path, fingerprints: Mapping[str, str]) -> None:
        self.channels: dict[str, Array] = {}
        for name, fingerprint in fingerprints.items():
            rows = array_of(path, name)
            if name == LABEL_SHAPES or rows.exists():
                self.channels[name] = _rows(rows, fingerprint, AXES[name])
        for name in TRUST:
            if name in fingerprints and not array_of(path, name).exists():
                note(f"only the model has {name}: frames are matched without")
            elif name not in fingerprints and array_of(path, name).exists():
                note(f"only {path} has {name}: frames are matched without; fuse the file again")
        if not (ids := beside(path, "frames")).exists():
            raise ValueError(f"{ids} does not exist; expected the ids of {path}, one a line")
        self.frames = ids.read_text(encoding="utf-8").splitlines()
        if not self.frames:
            raise ValueError(f"{path} holds no frames")
        for rows in self.channels.values():
            if len(rows) != len(self.frames):
                raise ValueError(f"{path}: {rows.shape} for {len(self.frames)} frames")
        self._poses = np.full((len(self.frames), 3), np.nan)
        if (file := array_of(path, "poses")).exists():
            with naming(file):
                self._poses = np.load(file)
            if self._poses.shape != (len(self.frames), 3):
                raise ValueError(f"{file}: {self._poses.shape} for {len(self.frames)} frames")
        sequences = groupby(self.frames, lambda frame: frame.rpartition("/")[0])
        self._map = DescriptorMap([len(list(sequence)) for _, sequence in sequences])
        for name, rows in self.channels.items():
            self._map.add(name, rows, TRUST[name])

    def find(
        self, sequence: Sequence[Description], follow: str | None = None, top: int = 5
    ) -> list[Answer]:
        """The places of the frames of a sequence, or of one frame, as `ssrvlad query` finds them,
        by all channels that both sides have.

        Args:
            sequence: the frames in order.
            follow: ``"offline"``, or ``None``, which judges each frame alone.
            top: number of candidates of each frame.

        Raises:
            ValueError: the descriptors have another length.
            RuntimeError: the core of the package is missing or of another version.
        """
        queries = {
            name: np.stack([frame.channels[name] for frame in sequence]) for name in self.channels
        }
        return self._answers(self._map.query(queries, follow=follow, top=top, threads=_threads()))

    def track(
        self, frames: Iterable[Description], delay: int = 0, top: int = 5
    ) -> Iterator[Answer]:
        """The answers to the frames of a sequence, each as soon as so many later frames have come,
        as `ssrvlad query --follow online` finds them. Until 30 frames have come, the mean of the
        map stands for that of the sequence. Errors are those of `find`."""
        tracker = DescriptorTracker(self._map, delay=delay, top=top, threads=_threads())
        for frame in frames:
            channels = frame.channels
            if answer := tracker.update({name: channels[name] for name in self.channels}):
                yield from self._answers(answer[1], answer[0] >= MIN_FRAMES)
        for number, decision in tracker.finish():
            yield from self._answers(decision, number >= MIN_FRAMES)

    def _answers(self, decision: Decision, settled: bool = True) -> list[Answer]:
        alone = "fused score" if len(self.channels) > 1 else "cosine"
        answers = []
        columns = decision.scores, decision.rows, decision.right, decision.follows
        for scores, best, right, follows in zip(*columns, strict=True):
            rows = best[best >= 0]
            ranked = [
                (self.frames[row], min(1.0, float(score)))
                for row, score in zip(rows, scores, strict=False)
            ]
            score_is = "probability" if follows else alone
            poses = [dict(zip(POSE, pose, strict=True)) for pose in self._poses[rows].tolist()]
            answers.append(Answer(ranked, score_is, float(right), settled, poses))
        return answers


def save(
    path: Path,
    descriptions: Sequence[Description],
    frames: Sequence[str],
    fingerprints: Mapping[str, str],
) -> None:
    """Writes frames as a database: the array of descriptors, those of the other channels, each with
    its fingerprint, and the ids beside them, without poses. An id of several lines is a ValueError.
    All files are written before the first replaces one of an earlier database, and the ids come
    last: a database that was cut off there has none, and is refused."""
    for frame in frames:
        require_one_line(frame)
    ids = beside(path, "frames")
    old = [ids, *(array_of(path, name) for name in {"poses", *TRUST} - {*fingerprints})]
    with ExitStack() as stack:  # the last file replaces first
        text = "".join(f"{frame}\n" for frame in frames)
        stack.enter_context(replacing(ids)).write_text(text, "utf-8", newline="\n")
        for name, fingerprint in fingerprints.items():
            array = array_of(path, name)
            mark = stack.enter_context(replacing(beside(array, "fingerprint")))
            mark.write_text(f"{fingerprint}\n", newline="\n")
            with stack.enter_context(replacing(array)).open("wb") as file:
                np.save(file, np.stack([frame.channels[name] for frame in descriptions]))
        for earlier in old:
            earlier.unlink(missing_ok=True)


def _threads() -> int:
    return os.cpu_count() or 1


def beside(path: Path, what: str) -> Path:
    """A text file that belongs to an array."""
    return path.with_name(f"{path.name}.{what}.txt")


def array_of(path: Path, channel: str) -> Path:
    """The array of a channel of a database, or of its poses."""
    return path if channel == LABEL_SHAPES else path.with_name(f"{path.name}.{channel}.npy")


def _rows(path: Path, fingerprint: str, axes: int) -> Array:
    """An array of frames with a fingerprint."""
    if not path.exists():
        raise ValueError(f"{path} does not exist")
    with naming(path):
        rows = open_memmap(path, mode="r")
    if rows.ndim != axes:
        raise ValueError(f"{path}: expected an array of {axes} axes, got {rows.shape}")
    if not beside(path, "fingerprint").exists():
        note(f"{path} has no fingerprint: it may not fit the model")
    elif (stored := beside(path, "fingerprint").read_text().strip()) != fingerprint:
        raise ValueError(
            f"{path} has fingerprint {stored}, the model {fingerprint}: they do not compare"
        )
    return rows


def require_one_line(frame: str) -> None:
    """Refuses an id of several lines: a database has one id a line."""
    if frame.splitlines() != [frame]:
        raise ValueError(f"a database has one id a line; frame {frame!r} has several lines")
