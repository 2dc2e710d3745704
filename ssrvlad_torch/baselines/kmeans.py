"""k-means: Lloyd's rounds from k-means++ seeds (Arthur and Vassilvitskii, SODA 2007)."""

from __future__ import annotations

import torch
from torch import Tensor

_BLOCK = 1 << 15


def kmeans(points: Tensor, count: int, seed: int = 0, rounds: int = 100) -> Tensor:
    """Centres of clusters, the same ones for the same points and seed.

    Args:
        points: ``(n, D)`` float.
        count: number of centres.
        seed: of the random numbers that choose the first centres.
        rounds: at most; the search ends when no point changes its cluster.

    Returns:
        ``(count, D)`` of the points' dtype. A centre that loses its last point stays.

    Raises:
        ValueError: fewer distinct points than centres.
    """
    centres = _seeds(points, count, torch.Generator().manual_seed(seed))
    before = torch.empty(0)
    for _ in range(rounds):
        nearest = nearest_centres(points, centres)
        if torch.equal(nearest, before):
            break
        before = nearest
        sizes = torch.bincount(nearest, minlength=count)[:, None]
        sums = torch.zeros_like(centres, dtype=torch.float64)
        sums.index_add_(0, nearest, points.double())
        centres = torch.where(sizes > 0, sums / sizes.clamp(min=1), centres).to(points.dtype)
    return centres


def nearest_centres(points: Tensor, centres: Tensor) -> Tensor:
    """``(n,)`` int64, the row of the centre nearest to each point."""
    squares = centres.square().sum(dim=1)
    blocks = points.split(_BLOCK)
    return torch.cat([(squares - 2 * block @ centres.mT).argmin(dim=1) for block in blocks])


def _seeds(points: Tensor, count: int, random: torch.Generator) -> Tensor:
    """Points drawn one after another, each with odds of its squared distance to those before."""
    odds = torch.ones(len(points), dtype=torch.float64)
    distance = torch.full_like(odds, torch.inf)
    centres: list[Tensor] = []
    while len(centres) < count:
        steps = odds.cumsum(0)
        if not len(odds) or not bool(steps[-1] > 0):
            raise ValueError(f"{count} centres need as many distinct points, got {len(centres)}")
        draw = torch.rand(1, dtype=torch.float64, generator=random) * steps[-1]
        chosen = torch.searchsorted(steps, draw, right=True).clamp(max=len(odds) - 1)
        centres.append(points[chosen[0]])
        for start in range(0, len(points), _BLOCK):
            part = slice(start, start + _BLOCK)
            apart = (points[part] - centres[-1]).double().square().sum(dim=1)
            distance[part] = distance[part].minimum(apart)
        odds = distance
    return torch.stack(centres)
