"""Rivals: is the best place of a query more than the best of many chance places?

The rivals of an answer are the best places elsewhere. If the answer is wrong, it is a chance place
among chance places. Of n independent normal values the steps from each to the next lower one,
divided by what they are on average, are nearly exponential with one scale (Renyi, 1953): if ``s``
is that of the answer over its best rival, and ``rest`` the sum of the m steps below, then ::

    chance = (1 + s / rest) ** -m

is uniform from 0 to 1, whatever mean and deviation the values have. The means of the steps are
those of normal order statistics (Blom, 1958). Nothing but `reference.ROWS_A_PLACE` is measured.
"""

from typing import NamedTuple

from torch import Tensor

from . import deciding


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
    return Chance(*deciding.chance(values, rows, count))
