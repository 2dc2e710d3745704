"""Which references may answer a query: by sequence, by number or time, and not its neighbours."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .frames import FrameSet, natural_key


def select(
    frames: FrameSet,
    sequences: Collection[str] | None = None,
    first: int | None = None,
    last: int | None = None,
) -> npt.NDArray[np.bool_]:
    """The frames of some sequences and of a window of time.

    The number of a frame is the last one in its name: a frame's number, or its time where names
    are time stamps.

    Args:
        frames: among these.
        sequences: the only ones, if given.
        first, last: least and greatest number, if given; a frame without a number is then none.

    Returns:
        ``(R,)`` bool.

    Raises:
        ValueError: a sequence is not there; the message names it.
    """
    chosen = np.ones(len(frames.frames), bool)
    if sequences is not None:
        missing = sorted(set(sequences) - set(frames.sequences))
        if missing:
            raise ValueError(f"there is no sequence {missing[0]!r} in the database")
        chosen &= np.fromiter((s in sequences for s in frames.sequences), bool, len(chosen))
    if first is not None or last is not None:
        inside = (_is_between(frame, first, last) for frame in frames.frames)
        chosen &= np.fromiter(inside, bool, len(chosen))
    return chosen


def neighbours(queries: Sequence[str], references: FrameSet, reach: int) -> npt.NDArray[np.int64]:
    """References of a query's own sequence that are near it in their order.

    Args:
        queries: ids of Q frames, which need not be among the references.
        references: frames in order.
        reach: so many on either side of the place that a query has, or would have.

    Returns:
        ``(Q, 2)`` int64, ranges of rows for `match` to exclude; the query's own row is inside.

    Raises:
        ValueError: ``reach`` is negative.
    """
    if reach < 0:
        raise ValueError(f"the reach of neighbours must be 0 or more frames, got {reach}")
    starts: dict[str, int] = {}
    ends: dict[str, int] = {}
    for row, sequence in enumerate(references.sequences):
        starts.setdefault(sequence, row)
        ends[sequence] = row + 1
    ranges = np.zeros((len(queries), 2), np.int64)
    for number, query in enumerate(queries):
        sequence, _, name = query.rpartition("/")
        if sequence in starts:
            start, end = starts[sequence], ends[sequence]
            place = bisect_left(references.frames, natural_key(name), start, end, key=_name_key)
            own = place < end and references.frames[place] == query
            ranges[number] = max(start, place - reach), min(end, place + reach + own)
    return ranges


def _name_key(frame: str) -> tuple[Any, str]:
    return natural_key(frame.rpartition("/")[2])


def _is_between(frame: str, first: int | None, last: int | None) -> bool:
    numbers = re.findall(r"\d+", frame.rpartition("/")[2])
    if not numbers:
        return False
    number = int(numbers[-1])
    return (first is None or number >= first) and (last is None or number <= last)
