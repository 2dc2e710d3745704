"""Vectors: descriptors of float numbers, compared by their cosine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from torch import Tensor

from ..recognition.comparison import ReferenceRows
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

    def references(
        self, stored: Tensor, sequences: Sequence[str], means: Tensor | None = None
    ) -> ReferenceRows:
        """See `Channel`."""
        return ReferenceRows(stored, sequences, means)
