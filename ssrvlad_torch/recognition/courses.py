"""Courses: how the queries of a sequence run a map, if they do, before they are followed along it.

The course says how to follow. Whether the queries run the map at all is shown by two things: by the
gain of the sequence, and by the confidence in its answers, followed and alone, which is one account
of both, see `rivals`. Gains a query: real drives and two streams in turn 0.3 to 1.0, three to six
streams 0.03 to 0.35, drives in foreign maps 0.05 to 0.4, random frames 0.0 to 0.1.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import torch

from .evidence import Evidence
from .motion import BACKWARDS, FORWARDS, Motion


class Course(NamedTuple):
    """How queries run a map: `motion.FORWARDS` or `motion.BACKWARDS`, at a rate, see
    `motion.Motion`, and as how many streams whose frames alternate."""

    way: int = FORWARDS
    rate: float = 1
    streams: int = 1

    def __str__(self) -> str:
        parts = (
            "backwards" * (self.way == BACKWARDS),
            f"at rate {self.rate:g}" * (self.rate != 1),
            f"{self.streams} streams in turn" * (self.streams != 1),
        )
        return ", ".join(part for part in parts if part)

    def parts(self, queries: range) -> list[range]:
        """The queries of each stream."""
        return [queries[number :: self.streams] for number in range(self.streams)]


_KINDS = (Course(), Course(rate=3), Course(rate=0.25), Course(streams=2))
_OF_TWO = 0.75
"""What counts of the gain of two streams: a slow one is hardly less likely as two in turn."""
_LEAST_GAIN, _UNUSUAL = 1.0, 3.0
"""The gain of a course, and how much more another than forwards at the rate of the map must have:
before anything is known, one drive in twenty takes it."""

_BY_ROWS = 0.25
"""How much of its gain a drive may have in a random order. A row of the map that is like every
query gains all of it."""

_DRIVE, _MARGIN = 0.5, 0.05
"""The gain a query that only drives have, and a difference of mean confidences."""


def course(evidence: Evidence) -> tuple[Course, float] | None:
    """The course of the queries of one sequence, and its gain a query: of all kinds and both ways
    the likeliest, by its gain; two streams need a third more gain than one. ``None`` if there is
    hardly any gain, or if the queries gain it in a random order too: then there is no drive."""
    queries, best, highest, likeliest = evidence.queries, None, 0.0, -math.inf
    for kind, way in product(_KINDS, (FORWARDS, BACKWARDS)):
        found = kind._replace(way=way)
        gain = _gain(evidence, found, found.parts(queries))
        likely = gain - _UNUSUAL * (found != Course())
        if likely > likeliest:
            best, highest, likeliest = found, gain, likely
    if best is None or highest <= _LEAST_GAIN:
        return None
    order = torch.randperm(len(queries), generator=torch.Generator().manual_seed(0)).tolist()
    shuffled = [[queries[place] for place in order[n :: best.streams]] for n in range(best.streams)]
    if _gain(evidence, best, shuffled) > _BY_ROWS * highest:
        return None
    return best, highest / len(queries)


def _gain(evidence: Evidence, kind: Course, parts: Sequence[Sequence[int]]) -> float:
    """The gain of streams of queries by a course; what counts of it."""
    motion = Motion(unmapped=0.0, rate=kind.rate)
    gain = sum(evidence.gain(part, motion, kind.way) for part in parts)
    return gain * (1 if kind.streams == 1 else _OF_TWO)


def is_followed(gain: float, followed: float, alone: float) -> bool:
    """Whether a sequence is followed, by its gain a query and by the mean confidence in its answers
    if it is followed and if each query is judged alone: a drive unless that makes its answers less
    sure, others only if it makes them surer."""
    return followed > alone + (-_MARGIN if gain > _DRIVE else _MARGIN)
