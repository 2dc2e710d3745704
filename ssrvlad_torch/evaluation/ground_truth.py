"""Ground truth: which references show the place of each query, as rows of the references."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..database import natural_key

Rows = npt.NDArray[np.int64]


def from_json(path: str | Path, queries: Sequence[str], references: Sequence[str]) -> list[Rows]:
    """True matches from a file ``{"<query id>": ["<reference id>", ...], ...}``.

    Entries of queries that are not asked for are ignored.

    Raises:
        ValueError: the file is of another form, has no entry for a query, or names a reference
            that is not among the references.
    """
    try:
        pairs = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read the ground truth {path}: {error}") from error
    if not isinstance(pairs, dict) or not all(_is_list_of_ids(ids) for ids in pairs.values()):
        raise ValueError(f'{path} must hold {{"<query id>": ["<reference id>", ...], ...}}')
    row = {frame: number for number, frame in enumerate(references)}
    truth = []
    for query in queries:
        if query not in pairs:
            raise ValueError(f"{path} has no entry for query {query}")
        strange = [frame for frame in pairs[query] if frame not in row]
        if strange:
            raise ValueError(f"{path} names reference {strange[0]!r}, which is not in the database")
        truth.append(np.array(sorted(row[frame] for frame in pairs[query]), np.int64))
    return truth


def _is_list_of_ids(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(frame, str) for frame in value)


def from_poses(
    queries: npt.NDArray[np.float64], references: npt.NDArray[np.float64], metres: float
) -> list[Rows]:
    """True matches are the references within a distance, the limit included.

    Args:
        queries: ``(Q, 2+)`` x and y in metres.
        references: ``(R, 2+)`` likewise.
        metres: largest distance of a true match.

    Raises:
        ValueError: a pose is missing (NaN), or the distance is negative.
    """
    if not metres >= 0:
        raise ValueError(f"the tolerance must be 0 metres or more, got {metres}")
    for name, poses in (("queries", queries), ("references", references)):
        missing = int(np.isnan(poses[:, :2]).any(axis=1).sum())
        if missing:
            raise ValueError(
                f"{missing} of {len(poses)} {name} have no pose; a tolerance in metres wants a "
                "poses.csv (frame,x,y,heading) in or beside their folder"
            )
    return [
        np.flatnonzero(np.hypot(*(references[:, :2] - query[:2]).T) <= metres) for query in queries
    ]


def from_frame_numbers(
    queries: Sequence[str], references: Sequence[str], frames: int
) -> list[Rows]:
    """True matches are the references at most so many frames away in the drive.

    Frames of one sequence, queries and references together, are counted in the order of their
    names. Where no sequence of the queries is among the references, both must be one sequence:
    two aligned traverses, in which the n-th frames belong together.

    Args:
        queries, references: frame ids, ``<sequence>/<name>``.
        frames: largest distance of a true match.

    Raises:
        ValueError: the sequences cannot be told to belong together, or ``frames`` is negative.
    """
    if frames < 0:
        raise ValueError(f"the tolerance must be 0 frames or more, got {frames}")
    of_queries = {_sequence(frame) for frame in queries}
    of_references = {_sequence(frame) for frame in references}
    if of_queries <= of_references:
        number = _numbers({*queries, *references})
        here = [(_sequence(frame), number[frame]) for frame in queries]
        there = [(_sequence(frame), number[frame]) for frame in references]
    elif len(of_queries) == len(of_references) == 1:
        query_number, number = _numbers(set(queries)), _numbers(set(references))
        here = [("", query_number[frame]) for frame in queries]
        there = [("", number[frame]) for frame in references]
    else:
        strange = min(of_queries - of_references)
        raise ValueError(
            f"a tolerance in frames cannot place query sequence {strange!r}: it is none of the "
            f"database's ({', '.join(sorted(of_references))}), and there is more than one"
        )
    names = np.array([name for name, _ in there])
    numbers = np.array([number for _, number in there], np.int64)
    return [
        np.flatnonzero((names == name) & (np.abs(numbers - number) <= frames))
        for name, number in here
    ]


def _sequence(frame: str) -> str:
    return frame.rpartition("/")[0]


def _numbers(frames: set[str]) -> dict[str, int]:
    """Position of each frame in its sequence."""
    counts: dict[str, int] = {}
    numbers = {}
    for frame in sorted(frames, key=natural_key):
        numbers[frame] = counts.get(_sequence(frame), 0)
        counts[_sequence(frame)] = numbers[frame] + 1
    return numbers
