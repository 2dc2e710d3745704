"""Multi-similarity loss: pulls frames of one place together and pushes others apart."""

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
    """Eq. 15 of Wang et al., CVPR 2019, over all pairs, as the mean over the queries ``()``. The
    defaults are those of the paper and of ``pytorch_metric_learning``.

    Args:
        similarity: ``(Q, R)`` cosines of queries and references.
        same: ``(Q, R)`` bool, the pairs that show the same place.
        other: ``(Q, R)`` bool, the pairs that show different places; by default all that are not
            ``same``. Pairs in neither, for example neighbours, do not count.
        alpha, beta: how much more the hardest pairs of ``same``, and of ``other``, weigh.
        base: the cosine (lambda of the paper) below which pairs of ``same`` weigh most, and above
            which pairs of ``other`` do.

    Raises:
        ValueError: the shapes differ, or there is no query.
    """
    other = ~same if other is None else other
    if similarity.ndim != 2 or not similarity.shape == same.shape == other.shape:
        shapes = ", ".join(str(tuple(matrix.shape)) for matrix in (similarity, same, other))
        raise ValueError(f"expected similarity, same and other of one shape (Q, R), got {shapes}")
    if len(similarity) == 0:
        raise ValueError("expected at least one query, got none")
    pull = _soft_excess(alpha * (base - similarity), same) / alpha
    push = _soft_excess(beta * (similarity - base), other) / beta
    return (pull + push).mean()


def _soft_excess(values: Tensor, counted: Tensor) -> Tensor:
    """log(1 + sum of exp) over the counted values of each row."""
    counted_values = values.masked_fill(~counted, float("-inf"))
    return torch.cat([torch.zeros_like(values[:, :1]), counted_values], 1).logsumexp(1)
