"""Scores of queries that are computed when they are read, some queries at a time."""

from collections.abc import Callable, Mapping
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
        part = slice(number * size, (number + 1) * size)
        scores = compute(part)
        return scores if excluded is None else scores.masked_fill_(excluded[part], -torch.inf)

    return Computed(lambda query: block(query // size)[query % size], queries)


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
    members: Mapping[str, Scores], decoys: Mapping[str, Scores]
) -> tuple[Scores | Tensor, Scores | None, dict[str, float]]:
    """The scores of all methods as one, those of the decoys fused alike if all methods have them,
    and the weights of several methods."""
    if len(members) == 1:
        [(name, scores)] = members.items()
        return scores, decoys.get(name), {}
    every = FusedScores(members)
    fits = len(every) * len(every[0]) <= IN_MEMORY

    def decoy_row(query: int) -> Tensor:
        both = [torch.cat((own[query], decoys[name][query])) for name, own in members.items()]
        rows = len(both[0]) // 2
        return fused(both, [*every.weights.values()], rows)[rows:]

    against = Computed(decoy_row, len(every)) if len(decoys) == len(members) else None
    return every.whole() if fits else every, against, every.weights
