"""Evidence: what is known of the queries of one sequence, by all rows of a map or by candidates."""

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from .candidates import Search, follow_candidates, gain_of_candidates
from .follow import Computed, Mode, Places, Scores, follow, gain
from .matching import Matches, best_of
from .motion import Motion, nearness
from .rivals import Chance, chance_of


class Evidence(Protocol):
    """The queries of one sequence, and how they fit a map.

    Attributes:
        queries: their numbers.
    """

    queries: range

    def gain(self, part: Sequence[int], motion: Motion, way: int) -> float:
        """How much likelier some of the queries are as a sequence that runs the map in a way than
        each alone, as a natural logarithm; see `filter.Filter.gain`."""

    def follow(
        self, part: range, motion: Motion, way: int, mode: Mode, delay: int, top: int
    ) -> Places:
        """The places of some of the queries, given one another; see `follow.follow`."""

    def is_empty(self, query: int) -> bool:
        """Whether a query has no candidate."""

    def judge(self, query: int, top: int) -> tuple[Matches, Chance]:
        """The candidates of a query alone, and how the first compares with its rivals."""


class AllRows(Evidence):
    """Scores ``(Q, R)`` of all rows, whose ``sequences`` are given."""

    def __init__(self, scores: Tensor | Scores, sequences: Sequence[str]) -> None:
        self.queries = range(len(scores))
        self._scores, self._sequences = scores, sequences

    def gain(self, part: Sequence[int], motion: Motion, way: int) -> float:
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

    def judge(self, query: int, top: int) -> tuple[Matches, Chance]:
        """See `Evidence`."""
        scores = self._scores[query]
        return best_of(scores, top), chance_of(nearness(scores.float()))


class Candidates(Evidence):
    """The candidates of some queries that a search finds among rows, whose ``sequences`` are
    given."""

    def __init__(self, search: Search, sequences: Sequence[str], queries: range) -> None:
        self.queries = queries
        self._search, self._sequences = search, sequences

    def gain(self, part: Sequence[int], motion: Motion, way: int) -> float:
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

    def judge(self, query: int, top: int) -> tuple[Matches, Chance]:
        """See `Evidence`."""
        rows = self._search.candidates(query).sort().values
        scores = self._search.scores(query, rows)
        chance = chance_of(nearness(scores.float()), rows, len(self._sequences))
        return best_of(scores, top, rows), chance
