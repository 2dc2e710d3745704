"""Rivals: is the best place of a query more than the best of many chance places?

The rivals of an answer are the best places elsewhere. If the answer is wrong, it is a chance place
among chance places. Of n independent normal values the steps from each to the next lower one,
divided by what they are on average, are nearly exponential with one scale (Renyi, 1953): if ``s``
is that of the answer over its best rival, and ``rest`` the sum of the m steps below, then ::

    chance = (1 + s / rest) ** -m

is uniform from 0 to 1, whatever mean and deviation the values have. The means of the steps are
those of normal order statistics (Blom, 1958). Nothing but `ROWS_A_PLACE` is measured.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from .motion import ELSEWHERE

PLACES = 10
"""Most places that are compared."""
ROWS_A_PLACE = 8.5
"""Mean distance of places: the best rows, each farther than `ELSEWHERE` from all better ones, of
maps of 60 to 600 rows are 8.2 to 9.1 rows apart."""


class Chance(NamedTuple):
    """How an answer compares with its rivals.

    Attributes:
        chance: probability that a wrong answer is as far ahead of its rivals, 0 to 1; 1 if the best
            rival is as good, or if there are fewer than two rivals.
        rival: row of the best rival; -1 without one.
    """

    chance: float
    rival: int


def chance_of(values: Tensor, rows: Tensor | None = None, count: int | None = None) -> Chance:
    """How the best row compares with the best rows elsewhere.

    Args:
        values: ``(N,)`` float, the higher the better, -inf where there can be no match: nearness,
            or the logarithm of a probability.
        rows: ``(N,)`` int64, rising, rows of the map; without, all rows.
        count: number of rows of the map that could match; without, of these.

    Examples:
        >>> chance_of(torch.eye(60)[3]).chance < 1e-6
        True
        >>> chance_of(torch.eye(60)[3] + torch.eye(60)[40])
        Chance(chance=1.0, rival=40)
    """
    best, found = best_places(values, rows)
    count = int((values > -torch.inf).sum()) if count is None else count
    rival = int(found[1]) if len(found) > 1 else -1
    places = count / ROWS_A_PLACE
    steps = (best[:-1] - best[1:])[: max(0, int(places) - 1)]
    if len(steps) < 2:
        return Chance(1.0, rival)
    ahead, *below = (steps / _mean_steps(places)[: len(steps)]).tolist()
    return Chance((1 + ahead / max(sum(below), _LEAST_STEP)) ** -len(below), rival)


def best_places(values: Tensor, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The best rows, each a peak and farther than `ELSEWHERE` from all better ones: at most
    `PLACES` values, falling, float64, and rows; arguments as for `chance_of`."""
    rows = torch.arange(len(values)) if rows is None else rows
    left = values.double().clone()
    steps = left.diff().masked_fill(rows.diff() > 1, 0).nan_to_num(0.0)
    left[1:][steps < 0] = -torch.inf
    left[:-1][steps > 0] = -torch.inf
    best, found = list[float](), list[int]()
    for _ in range(min(PLACES, len(left))):
        peak = int(left.argmax())
        if left[peak] == -torch.inf:
            break
        best.append(float(left[peak]))
        found.append(int(rows[peak]))
        ends = torch.tensor([found[-1] - ELSEWHERE, found[-1] + ELSEWHERE + 1])
        first, last = torch.searchsorted(rows, ends).tolist()
        left[first:last] = -torch.inf
    return torch.tensor(best, dtype=torch.double), torch.tensor(found, dtype=torch.int64)


_LEAST_STEP = 1e-9


@lru_cache(maxsize=256)
def _mean_steps(places: float) -> Tensor:
    """The mean steps of normal order statistics, from the highest of so many on."""
    ranks = torch.arange(1, min(PLACES, int(places)) + 1, dtype=torch.double)
    means = torch.special.ndtri(1 - (ranks - 0.375) / (places + 0.25))
    steps: Tensor = -means.diff()
    return steps
