"""Selection: which frames of a map are candidates, by sequence, by neighbourhood and by pose."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..database.frames import FrameSet, numbers_of
from ..datasets.names import name_of, split_id
from ..datasets.poses import parse_number
from ..evaluation.ground_truth import require_poses
from ..files import natural_key


def select(frames: FrameSet, sequences: Collection[str]) -> npt.NDArray[np.bool_]:
    """``(R,)`` bool, the frames of some sequences; names of no sequence are a ValueError."""
    missing = sorted(set(sequences) - set(frames.sequences))
    if missing:
        raise ValueError(f"there is no sequence {missing[0]!r} in the database")
    return np.fromiter((s in sequences for s in frames.sequences), bool, len(frames))


def neighbours(queries: Sequence[str], references: FrameSet, reach: int) -> npt.NDArray[np.int64]:
    """The references around each query in its own sequence: ``(Q, 2)`` int64, the first of these
    rows and the one after the last, with the query's own. ``reach`` is the number of frames, from
    0, on each side of the position that the query has or would have among the references, which are
    in natural order."""
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


class Near(NamedTuple):
    """A circle on the map of poses: its centre and its radius in metres."""

    x: float
    y: float
    metres: float

    @classmethod
    def of(cls, circle: str | Sequence[float]) -> Near:
        """The circle of three numbers, or of the text ``X,Y,METRES``; a ValueError if they are not
        finite or the radius is negative.

        Examples:
            >>> Near.of("12.5,-3,50")
            Near(x=12.5, y=-3.0, metres=50.0)
        """
        parts = map(parse_number, circle.split(",")) if isinstance(circle, str) else circle
        numbers = numbers_of(parts)
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or numbers[2] < 0:
            raise ValueError(
                "near: expected X,Y,METRES, three finite numbers, the last from 0, such as "
                f"12.5,-3,50, got {circle if isinstance(circle, str) else repr(circle)}"
            )
        return cls(*numbers)

    def __str__(self) -> str:
        return f"within {self.metres:g} m of {self.x:g}, {self.y:g}"

    def rows(self, poses: npt.NDArray[np.float64], path: str) -> npt.NDArray[np.bool_]:
        """``(R,)`` bool, which of the poses ``(R, 3)`` of candidates are inside, NaN where unknown;
        a ValueError if the candidates, of the map at ``path``, have no poses, or none inside."""
        metres = np.hypot(poses[:, 0] - self.x, poses[:, 1] - self.y)
        if np.isnan(metres).all():
            raise ValueError(f"near: expected candidates with poses, {path} has none")
        inside: npt.NDArray[np.bool_] = metres <= self.metres
        if not inside.any():
            nearest = f"the nearest is {np.nanmin(metres):.1f} m away"
            raise ValueError(f"near: no candidate of {path} is {self}; {nearest}")
        return inside


class Posed(NamedTuple):
    """The candidates, perhaps of a circle, of known position, and of known heading if that
    counts."""

    by_heading: bool
    circle: Near | Posed | None = None

    def __str__(self) -> str:
        return f"of known pose{f' {self.circle}' if self.circle else ''}"

    def rows(self, poses: npt.NDArray[np.float64], path: str) -> npt.NDArray[np.bool_]:
        """As `Near.rows`."""
        posed = require_poses(f"references of {path}", poses, self.by_heading)
        if self.circle is None:
            return posed
        return self.circle.rows(np.where(posed[:, None], poses, np.nan), path)


Circle = str | Sequence[float] | Posed
"""A place that is roughly known: x, y and a radius in metres, or the text ``X,Y,METRES``; or all
frames of known pose."""


def circle_of(near: Circle | None) -> Near | Posed | None:
    """The place that a user means."""
    return near if near is None or isinstance(near, Posed) else Near.of(near)
