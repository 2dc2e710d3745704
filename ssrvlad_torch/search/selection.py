"""Selection: which frames of a map are candidates."""

from bisect import bisect_left
from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from ..database.frames import FrameSet
from ..datasets.names import name_of, split_id
from ..files import natural_key


def select(frames: FrameSet, sequences: Collection[str] | None = None) -> npt.NDArray[np.bool_]:
    """``(R,)`` bool, the frames of some sequences, by default all; others are a ValueError."""
    if sequences is None:
        return np.ones(len(frames), bool)
    missing = sorted(set(sequences) - set(frames.sequences))
    if missing:
        raise ValueError(f"there is no sequence {missing[0]!r} in the database")
    return np.fromiter((s in sequences for s in frames.sequences), bool, len(frames))


def neighbours(
    queries: Sequence[str], references: FrameSet, reach: int | None
) -> npt.NDArray[np.int64]:
    """The references around each query in its own sequence: ``(Q, 2)`` int64, the first of these
    rows and the one after the last, with the query's own. ``reach`` is the number of frames, from
    0, on each side of the position that the query has or would have among the references, which are
    in natural order; without, there are none."""
    if reach is None:
        return np.zeros((len(queries), 2), np.int64)
    if reach < 0:
        raise ValueError(f"the reach of neighbours must be 0 or more frames, got {reach}")
    starts: dict[str, int] = {}
    ends: dict[str, int] = {}
    for row, sequence in enumerate(references.sequences):
        starts.setdefault(sequence, row)
        ends[sequence] = row + 1
    ranges = np.zeros((len(queries), 2), np.int64)
    for number, query in enumerate(queries):
        sequence, name = split_id(query)
        if sequence in starts:
            start, end = starts[sequence], ends[sequence]
            place = bisect_left(
                references.frames,
                natural_key(name),
                start,
                end,
                key=lambda frame: natural_key(name_of(frame)),
            )
            is_reference = place < end and references.frames[place] == query
            ranges[number] = max(start, place - reach), min(end, place + reach + is_reference)
    return ranges
