"""Ground truth from poses or frame numbers: rows of the references that show a query's place.

A query may have any number of true matches, also none. `ground_truth_files` reads ground truth from
files."""

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
) -> list[Rows | None]:
    """True matches of each query: the references within a distance in metres, limit included, and
    perhaps in degrees of heading. Poses are ``(N, 2+)``, x, y, heading in radians; ``None`` for a
    query of unknown pose. A limit out of range, and no pose at all, are a ValueError."""
    check_distance(metres)
    if degrees is not None and not degrees >= 0:
        raise ValueError(f"the tolerance must be 0 degrees or more, got {degrees}")
    by_heading = degrees is not None
    posed = require_poses("queries", queries, by_heading)
    require_poses("references", references, by_heading)
    limit = math.inf if degrees is None else math.radians(degrees) + _ROUNDING
    truth: list[Rows | None] = []
    for query, is_posed in zip(queries, posed, strict=True):
        rows = np.flatnonzero(np.hypot(*(references[:, :2] - query[:2]).T) <= metres)
        if by_heading:
            turn = (references[rows, 2] - query[2] + math.pi) % math.tau - math.pi
            rows = rows[np.abs(turn) <= limit]
        truth.append(rows if is_posed else None)
    return truth


def check_distance(metres: float) -> None:
    """Raises a ValueError for a tolerance that is negative, infinite or NaN."""
    if not 0 <= metres < math.inf:
        raise ValueError(f"the tolerance must be 0 metres or more and finite, got {metres}")


def require_poses(
    name: str, poses: npt.NDArray[np.float64], by_heading: bool = False
) -> npt.NDArray[np.bool_]:
    """``(N,)`` bool, which poses are known, with their headings if these count; a ValueError with
    the name of the frames if none is."""
    posed = np.zeros(len(poses), bool)
    if poses.shape[1] >= 2 + by_heading:
        posed = ~np.any(np.isnan(poses[:, : 2 + by_heading]), axis=1)
    if len(posed) and not posed.any():
        kind, unit = ("heading", "degrees") if by_heading else ("pose", "metres")
        raise ValueError(
            f"none of {len(posed)} {name} has a {kind}; a tolerance in {unit} requires a poses.csv "
            "(frame,x,y,heading) with their names, in or beside their folder"
        )
    return posed


def from_frame_numbers(
    queries: Sequence[str], references: Sequence[str], frames: int
) -> list[Rows]:
    """True matches of each query: the references at most ``frames`` frames away in the sequence, by
    the order of names. If the queries' sequences are not among the references', both must be one
    sequence of equal length. Others, and a negative number, are a ValueError."""
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
                "a tolerance in frames requires two sequences of equal length, got "
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
