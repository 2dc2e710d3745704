"""Comparison: the queries of one sequence against all rows of a map, by one channel."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from torch import Tensor

from .follow import Scores


class Comparison(NamedTuple):
    """The queries of one sequence against all rows of a map.

    Attributes:
        scores: ``(Q, R)`` cosines of the best anchor or move.
        width: of the sweep, in columns on each side.
    """

    scores: Scores
    width: int = 0


class References(Protocol):
    """The descriptors of a map by one channel."""

    def __len__(self) -> int: ...

    def compare(
        self, queries: Tensor, standardised: bool, sweep: bool, excluded: Tensor | None
    ) -> Comparison:
        """Compares the queries of one sequence, ``(Q, *shape)``, or ``(Q, S, *shape)`` from
        `sweep.COLUMNS`.

        Args:
            queries: raw descriptors.
            standardised: subtract the mean of each traverse, see `standardise`.
            sweep: use all anchors, or moves to both sides.
            excluded: ``(Q, R)`` bool, rows that are no candidates.
        """


class Member(NamedTuple):
    """One channel among those that are fused: raw descriptors of all queries, the map, and how much
    the channel counts before anything is known of a drive."""

    queries: Tensor
    references: References
    trust: float = 1.0
