"""Ground truth from poses or frame numbers: rows of the references that show a query's place.

A query may have any number of true matches, also none. `ground_truth_files` reads ground truth from
files.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from ..datasets.names import name_of, sequence_of
from ..files import natural_key
from .outcomes import Rows

_ROUNDING = 1e-9


def from_poses(
    queries: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64],
    metres: float,
    degrees: float | None = None,
) -> list[Rows]:
    """True matches of each query: the references within a distance in metres, including the limit,
    of any heading, or of one within some degrees. Poses are ``(Q, 2+)`` and ``(R, 2+)``, x and y in
    metres, then heading in radians. A missing pose (NaN), a negative limit and an infinite distance
    are a ValueError."""
    if not 0 <= metres < math.inf:
        raise ValueError(f"the tolerance must be 0 metres or more and finite, got {metres}")
    if degrees is not None and not degrees >= 0:
        raise ValueError(f"the tolerance must be 0 degrees or more, got {degrees}")
    for name, poses in (("queries", queries), ("references", references)):
        _require_known(name, "pose", poses[:, :2])
        if degrees is not None:
            _require_known(name, "heading", poses[:, 2:3])
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
    """True matches of each query: the references at most ``frames`` frames away in the drive.

    The frames of a sequence, queries and references together, of the ids ``<sequence>/<name>``, are
    numbered in the order of their names. If the queries' sequences are not among those of the
    references, queries and references must be one sequence each: aligned traverses of equal length,
    whose n-th frames match. Others, and a negative number, are a ValueError.
    """
    if frames < 0:
        raise ValueError(f"the tolerance must be 0 frames or more, got {frames}")
    of_queries, of_references = (
        {sequence_of(frame) for frame in ids} for ids in (queries, references)
    )
    shared = of_queries <= of_references
    if shared:
        query_numbers = reference_numbers = _numbers({*queries, *references})
    elif len(of_queries) == len(of_references) == 1:
        query_numbers, reference_numbers = _numbers({*queries}), _numbers({*references})
        if len(query_numbers) != len(reference_numbers):
            raise ValueError(
                "a tolerance in frames requires two traverses of equal length, got "
                f"{len(query_numbers)} query frames and {len(reference_numbers)} reference frames"
            )
    else:
        unknown = min(of_queries - of_references)
        raise ValueError(
            f"a tolerance in frames cannot align query sequence {unknown!r}: it is none of the "
            f"database's ({', '.join(sorted(of_references))}), and there is more than one"
        )
    sequences = np.array([reference_numbers[frame][0] for frame in references])
    numbers = np.array([reference_numbers[frame][1] for frame in references], np.int64)
    return [
        np.flatnonzero(
            ((sequences == sequence) | (not shared)) & (np.abs(numbers - number) <= frames)
        )
        for sequence, number in (query_numbers[frame] for frame in queries)
    ]


def _numbers(frames: Iterable[str]) -> dict[str, tuple[str, int]]:
    """Sequence of each frame, and its number in the sequence."""
    counts, numbers = Counter[str](), {}
    for frame in sorted(frames, key=lambda frame: natural_key(name_of(frame))):
        sequence = sequence_of(frame)
        numbers[frame] = sequence, counts[sequence]
        counts[sequence] += 1
    return numbers


def _require_known(name: str, kind: str, poses: npt.NDArray[np.float64]) -> None:
    missing = int(np.isnan(poses).any(axis=1).sum()) if poses.shape[1] else len(poses)
    if missing:
        unit = "metres" if kind == "pose" else "degrees"
        raise ValueError(
            f"{missing} of {len(poses)} {name} have no {kind}; a tolerance in {unit} requires a "
            "poses.csv (frame,x,y,heading) in or beside their folder"
        )
