"""Vectors: descriptors of float numbers, compared by their cosine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from torch import Tensor

from ..recognition.comparison import Comparison
from ..recognition.follow import in_blocks
from ..recognition.matching import Rows, Vectors, real_tensor
from ..recognition.standardise import standardise
from ..recognition.sweep import COLUMNS, narrowed, score
from .channel import PICTURE, Network, View
from .column import Column

if TYPE_CHECKING:
    from ..descriptor import SSRVLAD


class VectorChannel:
    """A channel of vectors of length 1, or zero for an empty frame. A subclass defines ``name``,
    ``length``, ``needs`` and `describe`."""

    name: str
    length: int
    needs: frozenset[str] = frozenset({PICTURE})
    trust = 1.0
    threads: int | None = None
    fingerprint = ""

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
        return VectorReferences(stored, sequences)


class VectorReferences:
    """The vectors ``(R, D)`` of a map, and the sequence of each."""

    def __init__(self, vectors: Vectors, sequences: Sequence[str]) -> None:
        self._vectors, self._sequences = real_tensor(vectors).float(), sequences
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
        anchors = queries.shape[1] if queries.ndim == 3 else 1
        scores = in_blocks(
            lambda part: score(queries[part], rows), len(queries), len(rows), anchors, excluded
        )
        return Comparison(scores, width)

    def _standardised(self, standardised: bool) -> Rows:
        if standardised not in self._rows:
            vectors = self._vectors
            self._rows[standardised] = Rows.of(
                standardise(vectors, self._sequences) if standardised else vectors
            )
        return self._rows[standardised]
