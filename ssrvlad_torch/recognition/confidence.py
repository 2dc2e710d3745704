"""Confidence: the probability that the first candidate is right.

Logistic functions, fitted by ``scripts/pages/recognition.py`` to decisions whose truth is known;
docs/recognition.md reports how well they hold on cities that they were not fitted to.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .motion import lead, moments, nearness

OFFLINE = (1.41, 0.39)
ONLINE = (1.39, 0.76)
SINGLE = (-2.69, 0.80, 3.25)

_CLAMP = 1e-4


def confidence_of_places(near: Tensor, mode: str) -> Tensor:
    """``(Q,)`` float32, 0 to 1, of places that `follow` found in a mode; ``near`` ``(Q,)`` is the
    probability of the neighbourhood of each first candidate."""
    offset, slope = OFFLINE if mode == "offline" else ONLINE
    return torch.sigmoid(offset + slope * torch.logit(near.float(), _CLAMP))


def confidence_of_scores(
    scores: Tensor, rows: Tensor | None = None, spread: tuple[float, float] | None = None
) -> Tensor:
    """Of a query that is judged alone, by the z-score and the lead of its first candidate.

    Args:
        scores: ``(N,)`` cosines of the query, -inf where there can be no match.
        rows: ``(N,)`` int64 rows of the map to which the scores belong; without, all rows.
        spread: mean and standard deviation of the nearness of all rows; without, of these scores.

    Returns:
        float32, 0 to 1; 0 without a candidate, and 0 if no row is elsewhere.
    """
    if not len(scores) or not bool((scores > -torch.inf).any()):
        return torch.tensor(0.0)
    mean, deviation = moments(scores) if spread is None else spread
    near = nearness(scores)
    ahead = lead(near[None], rows)[0]
    if not ahead.isfinite():
        return torch.tensor(0.0)
    offset, by_z, by_lead = SINGLE
    z = (near.max() - mean) / deviation
    return torch.sigmoid(offset + by_z * z + by_lead * ahead)
