"""Sweep: a query described from several anchors, so that a turned camera still matches.

A reference has one descriptor; its score is that of the best anchor. A wide sweep finds a camera
that is turned or moved aside, and costs a little where it is not. So a sequence is swept at the
width with the largest mean lead of the first candidates over a sample of its queries: how much
nearer each is than the best row elsewhere. No label is used. Not in the paper."""

import torch
from torch import Tensor

from .matching import Vectors, cosines, unit_queries

COLUMNS = tuple(range(-24, 25, 4))
"""Anchors of a query: columns of the working grid, relative to the vanishing column."""


@torch.no_grad()
def score(queries: Vectors, references: Vectors) -> Tensor:
    """Float32 cosines (Eq. 4) of queries to all references.

    Args:
        queries: ``(Q, D)`` float, or ``(Q, S, D)`` of a sweep, of which the best anchor counts.
        references: ``(R, D)`` float.

    Returns:
        ``(Q, R)``; -inf for empty references and for empty queries, whose descriptors are zero.

    Raises:
        ValueError: the shapes do not fit, or values are not finite.
    """
    swept = torch.as_tensor(queries)
    swept = swept[:, None] if swept.ndim == 2 else swept
    fixed = torch.as_tensor(references)
    if swept.ndim != 3 or fixed.ndim != 2 or swept.shape[2] != fixed.shape[1]:
        raise ValueError(
            "expected queries (Q, D) or (Q, S, D) and references (R, D) of one width D, got "
            f"{tuple(swept.shape)} and {tuple(fixed.shape)}"
        )
    scores = cosines(unit_queries(swept).flatten(0, 1), fixed)
    return scores.view(*swept.shape[:2], len(fixed)).amax(1)
