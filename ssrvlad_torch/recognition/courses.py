"""Courses: whether and how the queries of a sequence run a map, before they are followed along it.

A fair test: the same scores with the map run backwards. Light and errors that drift slowly make any
frames likelier as a sequence than each alone, but not likelier forwards than backwards.
"""

import math
from typing import NamedTuple

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
_MIN_LEAD, _MIN_LEAD_BY_ROOT = 1.0, 0.3
"""Least lead of one way over the other, as a logarithm: for any number of queries, and times the
square root of their number. Of 272 random draws of 10, of 30 and of all queries of the drives of
docs/fusion.md none had it, and of 16 of these maps in random order one."""


def course(evidence: Evidence) -> Course | None:
    """The course of the queries of one sequence, ``None`` if the evidence shows none. Of all
    kinds the one with the highest gain in either way is taken; two streams need a third more than
    one. It must be likelier in one way than in the other."""
    queries = evidence.queries
    best, highest, ahead = _KINDS[0], -math.inf, 0.0
    for kind in _KINDS:
        parts, motion = kind.parts(queries), Motion(unmapped=0.0, rate=kind.rate)
        forwards, backwards = (
            sum(evidence.gain(part, motion, way) for part in parts) for way in (FORWARDS, BACKWARDS)
        )
        counted = max(forwards, backwards) * (1 if kind.streams == 1 else _OF_TWO)
        if counted > highest:
            best, highest, ahead = kind, counted, forwards - backwards
    if abs(ahead) <= max(_MIN_LEAD, _MIN_LEAD_BY_ROOT * math.sqrt(len(queries))):
        return None
    return best._replace(way=FORWARDS if ahead > 0 else BACKWARDS)
