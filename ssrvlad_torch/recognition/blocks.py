"""Scores of queries that are computed when they are read, some queries at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .follow import Scores
from .fusion import FusedScores, fused
from .matching import Rows
from .sweep import score

IN_MEMORY = 1 << 26
"""Scores that are in memory at once."""


class BlockScores(Scores):
    """Scores of one sequence of queries, computed in blocks of queries that fit in memory."""

    def __init__(
        self,
        compute: Callable[[slice], Tensor],
        queries: int,
        references: int,
        anchors: int,
        excluded: Tensor | None,
    ) -> None:
        self._compute, self._queries, self._excluded = compute, queries, excluded
        fits = anchors * queries * references <= IN_MEMORY
        room = IN_MEMORY // (4 * anchors * max(1, references))
        self._size = queries if fits else max(1, room)
        self._first, self._block = 0, torch.empty(0)

    def __len__(self) -> int:
        return self._queries

    def __getitem__(self, query: int, /) -> Tensor:
        if not self._first <= query < self._first + len(self._block):
            self._first = query - query % self._size
            self._block = self._compute(slice(self._first, self._first + self._size))
        row = self._block[query - self._first]
        return row if self._excluded is None else row.masked_fill(self._excluded[query], -torch.inf)


def of_vectors(
    queries: Tensor,
    references: Rows,
    excluded: Tensor | None,
    compare: Callable[[Tensor, Rows], Tensor] = score,
) -> BlockScores:
    """The scores of queries ``(Q, D)`` or ``(Q, S, D)``."""
    anchors = queries.shape[1] if queries.ndim == 3 else 1
    return BlockScores(
        lambda part: compare(queries[part], references),
        len(queries),
        len(references),
        anchors,
        excluded,
    )


def fused_scores(
    members: Sequence[Scores], names: Sequence[str]
) -> tuple[Scores | Tensor, dict[str, float]]:
    """The scores of all methods as one, and the weights of several methods."""
    if len(members) == 1:
        return members[0], {}
    fused = FusedScores(dict(zip(names, members, strict=True)))
    fits = len(fused) * len(fused[0]) <= IN_MEMORY
    return fused.whole() if fits else fused, fused.weights


class FusedDecoys(Scores):
    """Scores of the decoys by all methods as one, as the scores of the map are fused."""

    def __init__(
        self, members: Sequence[Scores], decoys: Sequence[Scores], weights: Sequence[float]
    ) -> None:
        self._members, self._decoys, self._weights = members, decoys, weights

    def __len__(self) -> int:
        return len(self._decoys[0])

    def __getitem__(self, query: int, /) -> Tensor:
        if len(self._decoys) == 1:
            return self._decoys[0][query]
        pairs = zip(self._members, self._decoys, strict=True)
        both = [torch.cat((own[query], decoys[query])) for own, decoys in pairs]
        first = len(both[0]) // 2
        return fused(both, self._weights, first)[first:]


class SomeScores(Scores):
    """The scores of some queries."""

    def __init__(self, scores: Tensor | Scores, queries: range) -> None:
        self._scores, self._queries = scores, queries

    def __len__(self) -> int:
        return len(self._queries)

    def __getitem__(self, query: int, /) -> Tensor:
        return self._scores[self._queries[query]]
