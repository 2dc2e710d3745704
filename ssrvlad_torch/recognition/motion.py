"""Motion: how a sequence moves along the rows of a map, and how far apart rows show the same place.

It needs no torch."""

from __future__ import annotations

from typing import NamedTuple

from ..native.headers import model

FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""

SAME_PLACE_ROWS = int(model("Place")["near"])
"""Rows at most so far apart show the same place."""


class Course(NamedTuple):
    """How queries run a map: `FORWARDS` or `BACKWARDS`, at a rate in rows of the map a
    frame, and as how many streams whose frames alternate."""

    way: int = FORWARDS
    rate: float = 1
    streams: int = 1

    def __str__(self) -> str:
        words = (
            "backwards" * (self.way == BACKWARDS),
            f"at rate {self.rate:g}" * (self.rate != 1),
            f"{self.streams} streams in turn" * (self.streams != 1),
        )
        return ", ".join(word for word in words if word)
