"""A database in NumPy's form, as `ssrvlad db export --format npy` writes it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .frames import read_npy
from .model import Seen
from .output import note
from .scores import (
    FEATURES,
    HOG,
    LABEL_SHAPES,
    TRUST,
    cosines,
    cosines_of_signs,
    fused,
    weights_of,
)

Array = npt.NDArray[Any]

AXES = {LABEL_SHAPES: 2, FEATURES: 4, HOG: 2}
"""Of the array of each channel."""


class Database:
    """Descriptors of reference frames in a `.npy` file, read block by block, and the frames' ids.

    ``FILE.frames.txt`` holds the ids, one a line, ``FILE.fingerprint.txt`` the fingerprint, and
    ``FILE.features.npy`` and ``FILE.hog.npy`` the other channels, with fingerprints of their own.

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
            if (name in fingerprints) != array_of(path, name).exists():
                which = "the model" if name in fingerprints else path
                note(f"only {which} has {name}: frames are matched without")
        if not (ids := beside(path, "frames")).exists():
            raise ValueError(f"{ids} does not exist; expected the ids of {path}, one a line")
        self.frames = ids.read_text(encoding="utf-8").splitlines()
        for rows in self.channels.values():
            if len(rows) != len(self.frames):
                raise ValueError(f"{path}: {rows.shape} for {len(self.frames)} frames")

    def search(self, seen: Seen, top: int) -> list[tuple[str, float]]:
        """The frames with the highest scores, best first; of equal ones the earlier first.

        A score is a cosine (Eq. 4), of several anchors the best one, and with several channels in
        the frame and in the database a fused score, see `fused`. A zero vector, the descriptor of
        an empty frame, matches nothing.

        Raises:
            ValueError: the descriptor has another length.
        """
        given = seen.channels
        length, expected = seen.descriptor.shape[-1], self.channels[LABEL_SHAPES].shape[1]
        if length != expected:
            raise ValueError(f"expected a database of {length} numbers a frame, got {expected}")
        compare = {FEATURES: cosines_of_signs}
        parts = {
            name: compare.get(name, cosines)(given[name], rows)
            for name, rows in self.channels.items()
        }
        scores = next(iter(parts.values()))
        if len(parts) > 1:
            scores = fused([*parts.values()], weights_of(dict.fromkeys(parts, 0.0)))
        rows = np.flatnonzero(np.isfinite(scores))
        rows = rows[np.argsort(-scores[rows], kind="stable")[:top]]
        return [(self.frames[row], float(scores[row])) for row in rows]


def save(
    path: Path, seen: Sequence[Seen], frames: Sequence[str], fingerprints: Mapping[str, str]
) -> None:
    """Writes frames as a database: the arrays, and files with ids and fingerprints beside them.

    The array of descriptors is written last, every array whole or not at all.

    Args:
        path: the array of descriptors.
        seen: the frames.
        frames: their ids.
        fingerprints: of the channels that the frames have, by name.

    Raises:
        ValueError: an id has several lines.
        OSError: a file cannot be written.
    """
    for frame in frames:
        require_one_line(frame)
    beside(path, "frames").write_text("".join(f"{frame}\n" for frame in frames), encoding="utf-8")
    for name in reversed(TRUST):
        array = array_of(path, name)
        if name in fingerprints:
            _save(array, [each.channels[name] for each in seen], fingerprints[name])
        else:
            array.unlink(missing_ok=True)


def _save(path: Path, rows: Sequence[Any], fingerprint: str) -> None:
    beside(path, "fingerprint").write_text(f"{fingerprint}\n")
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            np.save(file, np.stack(rows))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def beside(path: Path, what: str) -> Path:
    """A text file that belongs to an array."""
    return path.with_name(f"{path.name}.{what}.txt")


def array_of(path: Path, channel: str) -> Path:
    """The array of a channel of a database."""
    return path if channel == LABEL_SHAPES else path.with_name(f"{path.name}.{channel}.npy")


def _rows(path: Path, fingerprint: str, axes: int) -> Array:
    """An array of frames with a fingerprint."""
    try:
        rows = read_npy(path, "r")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if rows.ndim != axes:
        raise ValueError(f"{path}: expected an array of {axes} axes, got {rows.shape}")
    if not beside(path, "fingerprint").exists():
        note(f"{path} has no fingerprint: it may not fit the model")
    elif (own := beside(path, "fingerprint").read_text().strip()) != fingerprint:
        raise ValueError(
            f"{path} has fingerprint {own}, the model {fingerprint}: they do not compare"
        )
    return rows


def require_one_line(frame: str) -> None:
    """Refuses an id of several lines: a database has one id a line."""
    if frame.splitlines() != [frame]:
        raise ValueError(f"a database has one id a line; frame {frame!r} has several lines")
