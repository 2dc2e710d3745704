"""Scores of queries that are computed when they are read, some queries at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from .follow import Scores
from .fusion import FusedScores, fused
from .matching import Rows
from .sweep import score

IN_MEMORY = 1 << 26
"""Scores that are in memory at once."""


class Computed(Scores):
    """The scores of each query by a function."""

    def __init__(self, compute: Callable[[int], Tensor], queries: int) -> None:
        self._compute, self._queries = compute, queries

    def __len__(self) -> int:
        return self._queries

    def __getitem__(self, query: int, /) -> Tensor:
        return self._compute(query)


def in_blocks(
    compute: Callable[[slice], Tensor],
    queries: int,
    references: int,
    anchors: int,
    excluded: Tensor | None,
) -> Computed:
    """Scores of one sequence of queries, computed in blocks of queries that fit in memory."""
    fits = anchors * queries * references <= IN_MEMORY
    size = queries if fits else max(1, IN_MEMORY // (4 * anchors * max(1, references)))

    @lru_cache(maxsize=1)
    def block(number: int) -> Tensor:
        return compute(slice(number * size, (number + 1) * size))

    def row(query: int) -> Tensor:
        row = block(query // size)[query % size]
        return row if excluded is None else row.masked_fill(excluded[query], -torch.inf)

    return Computed(row, queries)


def of_vectors(
    queries: Tensor,
    references: Rows,
    excluded: Tensor | None,
    compare: Callable[[Tensor, Rows], Tensor] = score,
) -> Computed:
    """The scores of queries ``(Q, D)`` or ``(Q, S, D)``."""
    sizes = len(queries), len(references), queries.shape[1] if queries.ndim == 3 else 1
    return in_blocks(lambda part: compare(queries[part], references), *sizes, excluded)


def fused_scores(
    members: Sequence[Scores], names: Sequence[str]
) -> tuple[Scores | Tensor, dict[str, float]]:
    """The scores of all methods as one, and the weights of several methods."""
    if len(members) == 1:
        return members[0], {}
    scores = FusedScores(dict(zip(names, members, strict=True)))
    fits = len(scores) * len(scores[0]) <= IN_MEMORY
    return scores.whole() if fits else scores, scores.weights


def fused_decoys(
    members: Sequence[Scores], decoys: Sequence[Scores], weights: Sequence[float]
) -> Scores:
    """Scores of the decoys by all methods as one, as the scores of the map are fused."""
    if len(decoys) == 1:
        return decoys[0]

    def row(query: int) -> Tensor:
        pairs = zip(members, decoys, strict=True)
        both = [torch.cat((own[query], against[query])) for own, against in pairs]
        first = len(both[0]) // 2
        return fused(both, weights, first)[first:]

    return Computed(row, len(decoys[0]))
