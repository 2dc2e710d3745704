"""Scores of queries that are computed when they are read, some queries at a time."""

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from .follow import Scores

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
