"""Evidence: what is known of the queries of one sequence, by all rows of a map or by candidates."""

import math
from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from .candidates import Search, follow_candidates, gain_of_candidates
from .decoys import Lead, lead_over_decoys
from .follow import Computed, Mode, Places, Scores, follow, gain
from .matching import Matches, best_of
from .motion import Motion


class Evidence(Protocol):
    """The queries of one sequence, and how they fit a map.

    Attributes:
        queries: their numbers.
    """

    queries: range

    def gain(self, part: range, motion: Motion, way: int) -> float:
        """How much likelier some of the queries are as a sequence that runs the map in a way than
        each alone, as a natural logarithm; see `filter.Filter.gain`."""

    def follow(
        self, part: range, motion: Motion, way: int, mode: Mode, delay: int, top: int
    ) -> Places:
        """The places of some of the queries, given one another; see `follow.follow`."""

    def is_empty(self, query: int) -> bool:
        """Whether a query has no candidate."""

    def judge(self, query: int, top: int) -> tuple[Matches, Lead]:
        """The candidates of a query alone, and its lead over the decoys."""


class AllRows(Evidence):
    """Scores ``(Q, R)`` of all rows, whose ``sequences`` are given, and those of the decoys."""

    def __init__(
        self, scores: Tensor | Scores, sequences: Sequence[str], decoys: Scores | None = None
    ) -> None:
        self.queries = range(len(scores))
        self._scores, self._sequences, self._decoys = scores, sequences, decoys

    def gain(self, part: range, motion: Motion, way: int) -> float:
        """See `Evidence`."""
        return gain(self._scores, self._sequences, motion, way, part)

    def follow(
        self, part: range, motion: Motion, way: int, mode: Mode, delay: int, top: int
    ) -> Places:
        """See `Evidence`."""
        some = Computed(lambda query: self._scores[part[query]], len(part))
        return follow(some, self._sequences, None, mode, delay, top, motion, way)

    def is_empty(self, query: int) -> bool:
        """See `Evidence`."""
        return not bool(self._scores[query].isfinite().any())

    def judge(self, query: int, top: int) -> tuple[Matches, Lead]:
        """See `Evidence`."""
        scores = self._scores[query]
        decoys = None if self._decoys is None else self._decoys[query]
        return best_of(scores, top), lead_over_decoys(scores, decoys)


class Candidates(Evidence):
    """The candidates of some queries that a search finds among rows, whose ``sequences`` are given,
    and those of a search by the decoys."""

    def __init__(
        self,
        search: Search,
        sequences: Sequence[str],
        queries: range,
        decoys: Search | None = None,
    ) -> None:
        self.queries = queries
        self._search, self._sequences, self._decoys = search, sequences, decoys

    def gain(self, part: range, motion: Motion, way: int) -> float:
        """See `Evidence`."""
        return gain_of_candidates(self._search, self._sequences, motion, way, part)

    def follow(
        self, part: range, motion: Motion, way: int, mode: Mode, delay: int, top: int
    ) -> Places:
        """See `Evidence`."""
        return follow_candidates(self._search, self._sequences, part, mode, delay, top, motion, way)

    def is_empty(self, query: int) -> bool:
        """See `Evidence`."""
        return len(self._search.candidates(query)) == 0

    def judge(self, query: int, top: int) -> tuple[Matches, Lead]:
        """See `Evidence`."""
        rows = self._search.candidates(query).sort().values
        scores = self._search.scores(query, rows)
        mean, deviation = self._search.spread(query)
        matches = best_of(scores, top, rows)
        if self._decoys is None:
            return matches, lead_over_decoys(scores, rows=rows, deviation=deviation)
        decoy_rows = self._decoys.candidates(query).sort().values
        decoys = self._decoys.scores(query, decoy_rows)
        mean_of_decoys, of_decoys = self._decoys.spread(query)
        apart = (mean - mean_of_decoys) / 2
        both = math.sqrt((deviation**2 + of_decoys**2) / 2 + apart**2)
        return matches, lead_over_decoys(scores, decoys, rows, decoy_rows, both)
