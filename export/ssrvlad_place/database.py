"""A database in NumPy's form, as `ssrvlad db export --format npy` writes it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .frames import read_npy
from .model import Seen
from .output import note
from .scores import WEIGHTS, cosines_of_signs, fused

Array = npt.NDArray[Any]

_BLOCK = 1 << 14


class Database:
    """Descriptors of reference frames in a `.npy` file, read block by block, and the frames' ids.

    ``FILE.frames.txt`` holds the ids, one a line, ``FILE.fingerprint.txt`` the fingerprint, and
    ``FILE.features.npy`` features, with a fingerprint of their own.

    Args:
        path: FILE.
        fingerprint: of the model.
        features: fingerprint of its features; empty without.

    Raises:
        ValueError: the files do not fit each other or the model.
        OSError: a file cannot be read.
    """

    def __init__(self, path: Path, fingerprint: str, features: str = "") -> None:
        self.descriptors, self.signs = _rows(path, fingerprint, 2), None
        signs = path.with_name(f"{path.name}.features.npy")
        if bool(features) != signs.exists():
            which = "the model" if features else path
            note(f"only {which} has features: frames are matched by their label maps alone")
        elif features:
            self.signs = _rows(signs, features, 4)
        if not (ids := beside(path, "frames")).exists():
            raise ValueError(f"{ids} does not exist; expected the ids of {path}, one a line")
        self.frames = ids.read_text(encoding="utf-8").splitlines()
        for rows in (self.descriptors, self.signs):
            if rows is not None and len(rows) != len(self.frames):
                raise ValueError(f"{path}: {rows.shape} for {len(self.frames)} frames")

    def search(
        self, query: Array, top: int, features: Array | None = None
    ) -> list[tuple[str, float]]:
        """The frames with the highest scores, best first; of equal ones the earlier first.

        A score is a cosine (Eq. 4), of several anchors the best one, with features in the query
        and in the database a fused score, see `fused`. A zero vector, the descriptor of an empty
        frame, matches nothing.

        Raises:
            ValueError: the query has another length.
        """
        scores = self._cosines(query)
        if features is not None and self.signs is not None:
            scores = fused([scores, cosines_of_signs(features, self.signs)], WEIGHTS)
        rows = np.flatnonzero(np.isfinite(scores))
        rows = rows[np.argsort(-scores[rows], kind="stable")[:top]]
        return [(self.frames[row], float(scores[row])) for row in rows]

    def _cosines(self, query: Array) -> Array:
        """``(R,)`` float32, -inf where a vector is zero."""
        anchors = query if query.ndim == 2 else query[None]
        if anchors.shape[1:] != self.descriptors.shape[1:]:
            raise ValueError(
                f"expected a database of {query.shape[-1]} numbers a frame, "
                f"got {self.descriptors.shape[1]}"
            )
        cosines = np.full(len(self.frames), -np.inf, np.float32)
        for first in range(0, len(cosines) if query.any() else 0, _BLOCK):
            block = np.asarray(self.descriptors[first : first + _BLOCK], np.float32)
            norms, products = np.linalg.norm(block, axis=1), (block @ anchors.T).max(1)
            np.divide(products, norms, out=cosines[first : first + len(block)], where=norms > 0)
        return cosines


def save(
    path: Path,
    seen: Sequence[Seen],
    frames: Sequence[str],
    fingerprint: str,
    features: str = "",
) -> None:
    """Writes frames as a database: the arrays, and files with ids and fingerprints beside them.

    The array of descriptors is written last, every array whole or not at all.

    Args:
        path: the array of descriptors.
        seen: the frames.
        frames: their ids.
        fingerprint: of the descriptors.
        features: fingerprint of the features, if the frames have some.

    Raises:
        ValueError: an id has several lines.
        OSError: a file cannot be written.
    """
    for frame in frames:
        require_one_line(frame)
    beside(path, "frames").write_text("".join(f"{frame}\n" for frame in frames), encoding="utf-8")
    signs = path.with_name(f"{path.name}.features.npy")
    signs.unlink(missing_ok=True)
    if features:
        _save(signs, [each.features for each in seen], features)
    _save(path, [each.descriptor for each in seen], fingerprint)


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
