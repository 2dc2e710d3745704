"""Vectors: descriptors of float numbers, compared by their cosine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Self

from torch import Tensor

from ..recognition.comparison import Comparison
from ..recognition.confidence import ALONE
from ..recognition.decoys import Mirror, decoy_scores
from ..recognition.follow import Scores, in_blocks
from ..recognition.matching import Rows, Vectors, real_tensor
from ..recognition.standardise import standardise
from ..recognition.sweep import COLUMNS, narrowed, score
from .channel import PICTURE, Network, View
from .column import Column
from .live_vectors import LiveVectors

if TYPE_CHECKING:
    from ..descriptor import SSRVLAD


class VectorChannel:
    """A channel of vectors of length 1, or zero for an empty frame. A subclass defines ``name``,
    ``length``, ``needs`` and `describe`, and, if it can, `mirrored`."""

    name: str
    length: int
    needs: frozenset[str] = frozenset({PICTURE})
    trust = 1.0
    threads: int | None = None
    fingerprint = ""
    mirrored: Mirror | None = None
    """From vectors ``(..., length)`` to those of the mirrored views."""

    @property
    def column(self) -> Column:
        """See `Channel`."""
        return Column(self.name, self.fingerprint, (self.length,))

    @classmethod
    def lacks(cls, network: Network | None) -> str:
        """See `Channel`."""
        if network is None and PICTURE in cls.needs:
            return f"{cls.name} describes pictures: expected images and a segmenter"
        return ""

    @classmethod
    def make(cls, _head: SSRVLAD, network: Network | None) -> Self:
        """See `Channel`."""
        if problem := cls.lacks(network):
            raise ValueError(problem)
        return cls()

    @classmethod
    def of(cls, _column: Column, _head: SSRVLAD) -> Self:
        """See `Channel`."""
        return cls()

    def describe(self, views: Sequence[View], columns: Sequence[int] = ()) -> Tensor:
        """See `Channel`."""
        raise NotImplementedError

    def references(self, stored: Tensor, sequences: Sequence[str]) -> VectorReferences:
        """See `Channel`."""
        return VectorReferences(stored, sequences, self.mirrored)

    def live(self) -> LiveVectors:
        """See `Channel`."""
        return LiveVectors(self.length)


class VectorReferences:
    """The vectors ``(R, D)`` of a map, and the sequence of each; without a mirror, comparisons have
    no decoys."""

    def __init__(
        self, vectors: Vectors, sequences: Sequence[str], mirror: Mirror | None = None
    ) -> None:
        self._vectors, self._sequences = real_tensor(vectors).float(), sequences
        self._mirror = mirror
        self._rows: dict[bool, Rows] = {}

    def __len__(self) -> int:
        return len(self._vectors)

    def compare(
        self, queries: Tensor, standardised: bool, sweep: bool, excluded: Tensor | None = None
    ) -> Comparison:
        """See `References`; the sweep is as wide as suits the scores, see `sweep.narrowed`."""
        rows, width = self._standardised(standardised), 0
        if queries.ndim == 3 and sweep:
            queries, width = narrowed(queries, rows, COLUMNS, standardised)
        else:
            queries = queries[:, queries.shape[1] // 2] if queries.ndim == 3 else queries
            queries = standardise(queries) if standardised else queries
        decoys = None
        if self._mirror is not None:
            mean = None if standardised else rows.mean()
            mirrored = partial(decoy_scores, mirror=self._mirror, mean=mean)
            decoys = _scores(mirrored, queries, rows, excluded)
        return Comparison(_scores(score, queries, rows, excluded), decoys, ALONE, width)

    def _standardised(self, standardised: bool) -> Rows:
        if standardised not in self._rows:
            vectors = self._vectors
            self._rows[standardised] = Rows.of(
                standardise(vectors, self._sequences) if standardised else vectors
            )
        return self._rows[standardised]


def _scores(
    compare: Callable[[Tensor, Rows], Tensor], queries: Tensor, rows: Rows, excluded: Tensor | None
) -> Scores:
    """The scores of queries ``(Q, D)`` or ``(Q, S, D)``, when they are read."""
    anchors = queries.shape[1] if queries.ndim == 3 else 1
    return in_blocks(
        lambda part: compare(queries[part], rows), len(queries), len(rows), anchors, excluded
    )
