"""Confidence: the probability that the first candidate is right, from the traverse itself.

Each answer comes with the probability that chance is as far ahead of its rivals, see `rivals`. Of
wrong answers ``t = -log(chance)`` has the density ``exp(-t)``; of right ones a gamma density of
larger mean. How many answers are wrong, and how far ahead the right ones are, is what makes the
answers of the traverse likely (Pounds and Morris, 2003); few answers show little, and the prior
decides. The doubt in an answer is the probability that it is of the wrong ones. All that is said of
several answers follows from their doubts. docs/how-sure.md reports how well it holds.
"""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from .follow import NEAR

TRACK = 10
"""Frames that a wrong answer lasts in a followed sequence."""

_FOREIGN = 0.1
"""Prior probability that the map has none of the places."""
_SLOPE, _DEVIATION, _SHAPES = 0.25, 0.6, (1.0, 2.0)
"""Of the gamma density of right answers: the median of its rate, the deviation of the logit of the
rate, and the shapes. With the first shape more right answers look like chance than with the second:
which is true, chances do not show."""
_POINTS, _REACH = (15, 11), 2.5
"""Of the grid for the fraction of wrong answers and for the rate, and its reach in deviations."""
_LEAST_CHANCE = math.exp(-20.0)
_NOTHING = 0.9
"""An interval of this width says nothing."""
_BLOCK = 1 << 12


class Confidence(NamedTuple):
    """How sure the answers to queries are.

    Attributes:
        right: ``(Q,)`` float32, the probability that the first candidate is right; 0 without one.
        spread: ``(Q,)`` float32, standard deviation of ``right``, as far as the traverse does not
            show how often such answers are right.
        together: ``(Q,)`` float32, how many neighbouring queries err together.
    """

    right: Tensor
    spread: Tensor
    together: Tensor

    @classmethod
    def of_chances(cls, chances: Tensor, together: float) -> Confidence:
        """Of one traverse by the chances ``(Q,)`` of `rivals`, NaN where there is no candidate;
        so many neighbouring queries err together."""
        known = ~chances.isnan()
        ahead = -chances[known].double().clamp(_LEAST_CHANCE, 1 - 1e-3).log()
        right, spread = (torch.zeros(len(chances)) for _ in range(2))
        if len(ahead):
            weights = _posterior(ahead, together)
            parts = [_moments(block, weights) for block in ahead.split(_BLOCK)]
            mean, deviation = (torch.cat(each) for each in zip(*parts, strict=True))
            right[known], spread[known] = mean.float(), deviation.float()
        return cls(right, spread, torch.full((len(chances),), float(together)))


class Prior(NamedTuple):
    """Points of the prior: the fraction of wrong answers, rate and shape of the gamma density of
    right ones, and the logarithm of the weight."""

    wrong: Tensor
    rate: Tensor
    shape: Tensor
    log_weight: Tensor


@cache
def prior() -> Prior:
    """The prior; its last point is a map that has none of the places."""
    fractions = (torch.arange(_POINTS[0], dtype=torch.double) + 0.5) / _POINTS[0]
    away = torch.linspace(-_REACH, _REACH, _POINTS[1], dtype=torch.double)
    rates = torch.sigmoid(math.log(_SLOPE / (1 - _SLOPE)) + _DEVIATION * away)
    axes = fractions, rates, torch.tensor(_SHAPES, dtype=torch.double)
    wrong, rate, shape = (each.flatten() for each in torch.meshgrid(*axes, indexing="ij"))
    log = torch.log_softmax(-away.square() / 2, 0) - math.log(len(fractions) * len(_SHAPES))
    log = log[:, None].expand(len(fractions), -1, len(_SHAPES)).flatten()
    last = torch.tensor([1.0, _SLOPE, _SHAPES[-1], math.log(_FOREIGN)], dtype=torch.double)
    parts = wrong, rate, shape, log + math.log(1 - _FOREIGN)
    return Prior(*(torch.cat((each, end[None])) for each, end in zip(parts, last, strict=True)))


def _likelier(ahead: Tensor) -> Tensor:
    """``(N, points)``, how much likelier each ``t`` ``(N,)`` is of a right answer than of a wrong
    one."""
    grid, ahead = prior(), ahead[:, None]
    log = grid.shape * grid.rate.log() - torch.lgamma(grid.shape)
    return (log + (grid.shape - 1) * ahead.log() + (1 - grid.rate) * ahead).exp()


def _posterior(ahead: Tensor, together: float) -> Tensor:
    """``(points,)``, the weight of each; queries that err together count as one."""
    grid, log = prior(), torch.zeros(len(prior().wrong), dtype=torch.double)
    for block in ahead.split(_BLOCK):
        log += (grid.wrong + (1 - grid.wrong) * _likelier(block)).log().sum(0)
    return (grid.log_weight + log / together).softmax(0)


def _moments(ahead: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``(N,)`` of the probability to be right."""
    wrong = prior().wrong
    right = (1 - wrong) * _likelier(ahead)
    right /= right + wrong
    mean = right @ weights
    return mean, ((right - mean[:, None]).square() @ weights).sqrt()


def answers_together(rows: Tensor) -> float:
    """How many neighbouring queries have one answer, by the best rivals ``(Q,)`` of a traverse: the
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
        wrong: estimated fraction of them that is wrong, 0 to 1, the mean of their doubts; 0 if none
            is accepted.
        low, high: ends of its 95 % interval; ``None`` where it would say nothing.
    """

    confidence: float
    accepted: int
    wrong: float
    low: float | None
    high: float | None


def estimate(sure: Confidence, least: float = 0.0) -> Estimate:
    """The estimate for answers with a confidence of at least ``least``.

    The number of wrong answers varies by chance, counted in clusters of answers that err together,
    and by what the traverse does not show. The fraction is given the beta distribution of that
    variance.
    """
    accepted = answered(sure) & (sure.right >= least)
    count = int(accepted.sum())
    if not count:
        return Estimate(torch.inf, 0, 0.0, 0.0, 0.0)
    doubts = 1 - sure.right[accepted].double()
    wrong = float(doubts.mean())
    by_chance = doubts * (1 - doubts) * sure.together[accepted] / count
    ends = _beta(wrong, float(sure.spread[accepted].mean()) ** 2 + float(by_chance.mean()))
    low, high = math.floor(ends[0] * count) / count, math.ceil(ends[1] * count) / count
    said = (low, high) if high - low <= _NOTHING else (None, None)
    return Estimate(float(least), count, wrong, *said)


def accept(sure: Confidence, max_wrong: float) -> Estimate:
    """The estimate that accepts most answers while it is at most ``max_wrong``, 0 to 1; none if an
    interval would say nothing."""
    order = sure.right[answered(sure)].double().sort(descending=True).values
    permitted = (1 - order).cumsum(0) <= max_wrong * torch.arange(1, len(order) + 1)
    last = torch.ones_like(permitted)
    last[:-1] = order[1:] < order[:-1]
    chosen = (permitted & last).nonzero()[:, 0]
    found = estimate(sure, float(order[chosen[-1]]) if len(chosen) else torch.inf)
    return estimate(sure, torch.inf) if found.low is None else found


def answered(sure: Confidence) -> Tensor:
    """``(Q,)`` bool, whether a query has a candidate."""
    return sure.right > 0


def _beta(mean: float, variance: float) -> tuple[float, float]:
    """The quantiles 0.025 and 0.975 of the beta distribution with a mean and a variance; beyond
    logits of `_FAR` they are 0 and 1."""
    mean = min(max(mean, _TINY), 1 - _TINY)
    size = max(mean * (1 - mean) / max(variance, _TINY**2) - 1, _TINY)
    logits = torch.linspace(-_FAR, _FAR, 601, dtype=torch.double)
    log = mean * size * logsigmoid(logits) + (1 - mean) * size * logsigmoid(-logits)
    scale = float(log.max())
    inside = (log - scale).exp().cumsum(0) * float(logits[1] - logits[0])
    before, after = (
        math.exp(-_FAR * size * part - scale) / (size * part) for part in (mean, 1 - mean)
    )
    below = (before + inside) / (before + float(inside[-1]) + after)
    ends = torch.cat((torch.zeros(1), torch.sigmoid(logits[1:]), torch.ones(1)))
    low, high = ends[torch.searchsorted(below, torch.tensor([0.025, 0.975]).double())].tolist()
    return low, high


_TINY, _FAR = 1e-6, 15.0
