"""Ground truth: which references show the place of each query, as rows of the references.

A true match is a row of the references; a query may have any number of them, or none. Here it
comes from what is known of the frames; `ground_truth_files` reads it from files.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
from natsort import natsorted

from .outcomes import Rows

_ROUNDING = 1e-9


def from_poses(
    queries: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64],
    metres: float,
    degrees: float | None = None,
) -> list[Rows]:
    """True matches are the references within a distance, the limit included.

    Args:
        queries: ``(Q, 2+)`` x and y in metres, and heading in radians if ``degrees`` is given.
        references: ``(R, 2+)`` likewise.
        metres: largest distance of a true match.
        degrees: largest difference of the headings, either way round; ``None`` for any.

    Raises:
        ValueError: a pose is missing (NaN), or a limit is negative.
    """
    if not metres >= 0:
        raise ValueError(f"the tolerance must be 0 metres or more, got {metres}")
    if degrees is not None and not degrees >= 0:
        raise ValueError(f"the tolerance must be 0 degrees or more, got {degrees}")
    for name, poses in (("queries", queries), ("references", references)):
        _refuse_missing(name, "pose", poses[:, :2])
        if degrees is not None:
            _refuse_missing(name, "heading", poses[:, 2:3])
    near = [
        np.flatnonzero(np.hypot(*(references[:, :2] - query[:2]).T) <= metres) for query in queries
    ]
    if degrees is None:
        return near
    limit = math.radians(degrees) + _ROUNDING
    return [
        rows[np.abs((references[rows, 2] - query[2] + math.pi) % math.tau - math.pi) <= limit]
        for rows, query in zip(near, queries, strict=True)
    ]


def from_frame_numbers(
    queries: Sequence[str], references: Sequence[str], frames: int
) -> list[Rows]:
    """True matches are the references at most so many frames away in the drive.

    Frames of one sequence, queries and references together, are counted in the order of their
    names. Where no sequence of the queries is among the references, both must be one sequence:
    two aligned traverses of one length, in which the n-th frames belong together.

    Args:
        queries, references: frame ids, ``<sequence>/<name>``.
        frames: largest distance of a true match.

    Raises:
        ValueError: the sequences cannot be told to belong together, aligned traverses are not of
            one length, or ``frames`` is negative.
    """
    if frames < 0:
        raise ValueError(f"the tolerance must be 0 frames or more, got {frames}")
    of_queries, of_references = (
        {frame.rpartition("/")[0] for frame in ids} for ids in (queries, references)
    )
    shared = of_queries <= of_references
    if shared:
        here = there = _places({*queries, *references})
    elif len(of_queries) == len(of_references) == 1:
        here, there = _places({*queries}), _places({*references})
        if len(here) != len(there):
            raise ValueError(
                "a tolerance in frames wants two traverses of one length, got "
                f"{len(here)} query frames and {len(there)} reference frames"
            )
    else:
        strange = min(of_queries - of_references)
        raise ValueError(
            f"a tolerance in frames cannot place query sequence {strange!r}: it is none of the "
            f"database's ({', '.join(sorted(of_references))}), and there is more than one"
        )
    names = np.array([there[frame][0] for frame in references])
    numbers = np.array([there[frame][1] for frame in references], np.int64)
    return [
        np.flatnonzero(((names == name) | (not shared)) & (np.abs(numbers - number) <= frames))
        for name, number in (here[frame] for frame in queries)
    ]


def _places(frames: Iterable[str]) -> dict[str, tuple[str, int]]:
    """Sequence of each frame, and its position there."""
    counts, places = Counter[str](), {}
    for frame in natsorted(sorted(frames)):
        sequence = frame.rpartition("/")[0]
        places[frame] = sequence, counts[sequence]
        counts[sequence] += 1
    return places


def _refuse_missing(name: str, what: str, poses: npt.NDArray[np.float64]) -> None:
    missing = int(np.isnan(poses).any(axis=1).sum()) if poses.shape[1] else len(poses)
    if missing:
        unit = "metres" if what == "pose" else "degrees"
        raise ValueError(
            f"{missing} of {len(poses)} {name} have no {what}; a tolerance in {unit} wants a "
            "poses.csv (frame,x,y,heading) in or beside their folder"
        )
