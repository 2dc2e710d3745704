"""Confidence: the probability that the first candidate is right, from the traverse itself.

Wrong answers fall on the map and on its decoys alike, see `decoys`. If ``exp(a + b * lead)`` is how
much likelier a lead is of a right answer than of a wrong one, a winner whose lead is ``f`` is of
the map, not a decoy, with the probability ::

    (1 + exp(a + b * f)) / (2 + exp(a + b * f) + exp(a - b * f))

The winners of a traverse thus show ``a`` and ``b`` without ground truth. A few queries show little:
the prior decides then. Above a threshold, the decoys that win estimate how many answers are wrong.
What decoys cannot see is wrong without being counted: streets that repeat, and a place beside the
right one. docs/how-sure.md reports how well all this holds.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .follow import NEAR, Mode
from .standardise import MIN_FRAMES


class Prior(NamedTuple):
    """``a`` and ``b`` before a traverse is seen."""

    offset: float
    slope: float


ALONE = Prior(-1.35, 1.6)
ALONE_BY_FEATURES = Prior(-1.35, 3.0)
ONLINE = Prior(-0.5, 0.9)
OFFLINE = Prior(-3.0, 1.16)
"""Of queries judged alone, without and with features, and of followed ones.
docs/how-sure.md names the data, and the script that chose them."""

TRACK = 10
"""Frames that a wrong answer lasts in a followed sequence."""

_DEVIATIONS = (1.0, 0.5)
"""Of ``a`` and of ``log(b)`` in a prior."""
_LEAST_BELIEF = 1e-4
_GRID, _REACH, _MOST = 33, 4.0, 2000
"""Points of the grid for each of ``a`` and ``log(b)``, its reach in deviations, and the number of
queries that are looked at."""
_BLOCK = 1 << 12


class Confidence(NamedTuple):
    """How sure the answers to queries are.

    Attributes:
        right: ``(Q,)`` float32, the probability that the first candidate is right; 0 without one.
            Monotone in the lead over the decoys.
        decoy: ``(Q,)`` float32, where the decoy wins: ``right`` of an answer with its lead; else 0.
            NaN where there are no decoys.
        together: ``(Q,)`` float32, how many neighbouring queries err together.
    """

    right: Tensor
    decoy: Tensor
    together: Tensor

    @classmethod
    def of_leads(
        cls, leads: Tensor, prior: Prior, together: float, decoys: bool = True
    ) -> Confidence:
        """Of one traverse by the leads ``(Q,)`` of the winners, negative where it is the decoy, and
        NaN where there is no candidate. Without decoys the prior alone decides."""
        known = ~leads.isnan()
        lost = known & (leads < 0)
        right, decoy = (torch.zeros(len(leads)) for _ in range(2))
        offsets, slopes, weights = _posterior(leads[known & decoys], prior, together)
        for found, where, some in ((right, known, leads), (decoy, lost, -leads)):
            blocks = [
                torch.sigmoid(offsets + slopes * block[:, None]) @ weights
                for block in some[where].double().split(_BLOCK)
            ]
            found[where] = torch.cat([torch.zeros(0), *(block.float() for block in blocks)])
        decoy = decoy if decoys else torch.full_like(decoy, torch.nan)
        return cls(right, decoy, torch.full((len(leads),), float(together)))

    @classmethod
    def of_places(cls, near: Tensor, backward: Tensor, mode: Mode) -> Confidence:
        """Of one followed traverse, see `Places`."""
        near, backward = (each.clamp(min=_LEAST_BELIEF) for each in (near, backward))
        prior = OFFLINE if mode == "offline" else ONLINE
        return cls.of_leads((near / backward).log(), prior, TRACK)


def _posterior(leads: Tensor, prior: Prior, together: float) -> tuple[Tensor, Tensor, Tensor]:
    """``a``, ``b`` and the weight of each grid point; queries that err together are one."""
    steps = torch.linspace(-_REACH, _REACH, _GRID, dtype=torch.double)
    across, along = (each.flatten() for each in torch.meshgrid(steps, steps, indexing="ij"))
    offsets = prior.offset + _DEVIATIONS[0] * across
    slopes = prior.slope * (_DEVIATIONS[1] * along).exp()
    log = -(across.square() + along.square()) / 2
    sample = leads[:: -(-len(leads) // _MOST) or 1].double()
    share = len(leads) / max(1, len(sample)) / together
    ahead = sample[:, None].abs() * slopes
    won, lost = F.softplus(offsets + ahead), F.softplus(offsets - ahead)
    winner = torch.where(sample[:, None] > 0, won, lost)
    log += share * (winner - torch.logaddexp(won, lost)).sum(0)
    return offsets, slopes, log.softmax(0)


def answers_together(rows: Tensor) -> float:
    """How many neighbouring queries have one answer, by the best decoys ``(Q,)`` of a traverse: the
    mean over the queries of the length of their run, whose rows are at most `NEAR` apart. It is the
    design effect of a sample in clusters (Kish, Survey Sampling, 1965)."""
    if not len(rows):
        return 1.0
    apart = (rows.diff().abs() > NEAR).nonzero()[:, 0].tolist()
    ends = [-1, *apart, len(rows) - 1]
    lengths = [after - before for before, after in itertools.pairwise(ends)]
    return float(sum(length * length for length in lengths) / len(rows))


class Estimate(NamedTuple):
    """How many of the accepted answers are wrong, without ground truth.

    Attributes:
        confidence: the least of an accepted answer; infinite if none is accepted.
        accepted: number of answers.
        wrong: estimated fraction of them that is wrong, 0 to 1; 0 if none is accepted.
        low, high: ends of its 95 % interval.
    """

    confidence: float
    accepted: int
    wrong: float
    low: float
    high: float


def estimate(sure: Confidence, least: float = 0.0) -> Estimate:
    """The estimate for answers that beat the decoys, with a confidence of at least ``least``.

    From `MIN_FRAMES` queries on, the wrong answers are as many as the decoys that win with such a
    confidence, plus one: decoys are counted before the next would come. With fewer queries, or
    without decoys, they are the sum of the doubts. Given the decoys, the wrong answers have a
    negative binomial distribution, counted in clusters of answers that err together.
    """
    accepted = answered(sure) & (sure.right >= least)
    if not accepted.any():
        return Estimate(torch.inf, 0, 0.0, 0.0, 0.0)
    count, clusters = int(accepted.sum()), float(sure.together.mean())
    if _counted(sure):
        decoys = float(((sure.decoy >= least) & (sure.decoy > 0)).sum())
        wrong = decoys + 1
    else:
        decoys = wrong = float((1 - sure.right[accepted]).sum())
    ends = (
        clusters * _quantile(decoys / clusters + after, probability)
        for after, probability in ((0, 0.025), (1, 0.975))
    )
    fraction, low, high = (min(1.0, each / count) for each in (wrong, *ends))
    return Estimate(float(least), count, fraction, low, high)


def accept(sure: Confidence, max_wrong: float) -> Estimate:
    """The estimate that accepts most answers while it is at most ``max_wrong``, 0 to 1."""
    order = sure.right[answered(sure)].sort(descending=True).values
    if _counted(sure):
        decoys = sure.decoy[sure.decoy > 0].sort().values
        wrong = 1 + len(decoys) - torch.searchsorted(decoys, order)
    else:
        wrong = (1 - order).cumsum(0)
    permitted = wrong <= max_wrong * torch.arange(1, len(order) + 1)
    last = torch.ones_like(permitted)
    last[:-1] = order[1:] < order[:-1]
    chosen = (permitted & last).nonzero()[:, 0]
    return estimate(sure, float(order[chosen[-1]]) if len(chosen) else torch.inf)


def answered(sure: Confidence) -> Tensor:
    """``(Q,)`` bool, whether a query has a candidate and no decoy beats it."""
    return (sure.right > 0) & ~(sure.decoy > 0)


def _counted(sure: Confidence) -> bool:
    """Whether decoys are enough to count wrong answers."""
    return len(sure.right) >= MIN_FRAMES and not bool(sure.decoy.isnan().any())


def _quantile(failures: float, probability: float) -> int:
    """The quantile of the successes before a number of failures, both equally likely."""
    if failures <= 0:
        return 0
    most = int(2 * failures + 20 * math.sqrt(failures) + 40)
    counts = torch.arange(most, dtype=torch.double)
    start = torch.tensor(failures, dtype=torch.double)
    log = torch.lgamma(counts + start) - torch.lgamma(counts + 1) - torch.lgamma(start)
    below = (log - (counts + start) * torch.log(torch.tensor(2.0))).exp().cumsum(0)
    return int((below < probability).sum())
