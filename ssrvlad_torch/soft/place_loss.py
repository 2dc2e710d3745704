"""Multi-similarity loss: frames of one place together, others apart, hard pairs first."""

from __future__ import annotations

import torch
from torch import Tensor


def multi_similarity(
    similarity: Tensor,
    same: Tensor,
    other: Tensor | None = None,
    alpha: float = 2.0,
    beta: float = 50.0,
    base: float = 0.5,
) -> Tensor:
    """The mean over the queries of Eq. 15 of Wang et al., CVPR 2019, of all pairs.

    The defaults are the paper's, and those of ``pytorch_metric_learning``, of whose
    ``MultiSimilarityLoss`` this has the numbers where every query has a pair.

    Args:
        similarity: ``(Q, R)`` cosines of queries and references.
        same: ``(Q, R)`` bool, the pairs that show one place.
        other: ``(Q, R)`` bool, those that do not; without, all that are not ``same``. Pairs in
            neither, neighbours say, do not count.
        alpha, beta: how much more the worst of the same, and of the other pairs, count.
        base: the cosine from which on pairs count.

    Returns:
        ``()``, 0 or more.

    Raises:
        ValueError: the shapes differ, or there is no query.
    """
    other = ~same if other is None else other
    if similarity.ndim != 2 or not similarity.shape == same.shape == other.shape:
        shapes = ", ".join(str(tuple(part.shape)) for part in (similarity, same, other))
        raise ValueError(f"expected similarity, same and other of one shape (Q, R), got {shapes}")
    if len(similarity) == 0:
        raise ValueError("expected at least one query, got none")
    pull = _soft_excess(alpha * (base - similarity), same) / alpha
    push = _soft_excess(beta * (similarity - base), other) / beta
    return (pull + push).mean()


def _soft_excess(values: Tensor, counted: Tensor) -> Tensor:
    """log(1 + sum of exp) over the values that are counted, row by row."""
    counted_values = values.masked_fill(~counted, float("-inf"))
    return torch.cat([torch.zeros_like(values[:, :1]), counted_values], 1).logsumexp(1)
