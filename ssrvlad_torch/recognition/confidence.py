"""Confidence: the probability that the first candidate is right, from the sequence itself.

Each answer comes with the probability that chance is as far ahead of its rivals as it is. Of wrong
answers ``t = -log(chance)`` has the density ``exp(-t)``; of right ones a gamma density of larger
mean. Where the map lacks the place all answers are wrong; a hidden Markov chain says where. How
many of the others are wrong, and how far ahead the right ones are, is what makes these answers
likely (Pounds and Morris, 2003); few answers show little, and the prior decides. The doubt in an
answer is the probability that it is wrong. `tests/oracles/recognition.py` has the formulas."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

_NOTHING = 0.9
"""An interval of this width says nothing."""


class Confidence(NamedTuple):
    """How sure the answers to queries are.

    Attributes:
        right: ``(Q,)`` float32, the probability that the first candidate is right; 0 without one,
            and where the map has too few references to say.
        spread: ``(Q,)`` float32, standard deviation of ``right``, as far as the sequence does not
            show how often such answers are right.
        together: ``(Q,)`` float32, how many neighbouring queries err together; 0 without a
            candidate, and only there.
    """

    right: Tensor
    spread: Tensor
    together: Tensor


class Estimate(NamedTuple):
    """How many of the accepted answers are wrong, without ground truth.

    Attributes:
        confidence: the least of an accepted answer; infinite if none is accepted.
        accepted: number of answers.
        wrong: estimated fraction of them that is wrong, 0 to 1, the mean of their doubts; 0 if none
            is accepted, 1 where the map has too few references to say.
        low, high: ends of its 95 % interval; ``None`` where it would say nothing.
    """

    confidence: float
    accepted: int
    wrong: float
    low: float | None
    high: float | None


def estimate(sure: Confidence, least: float = 0.0) -> Estimate:
    """The estimate for answers with a confidence of at least ``least``. The fraction of wrong ones
    is given the beta distribution whose variance comes from chance, counted in clusters of answers
    that err together, and from what the sequence does not show."""
    accepted = answered(sure) & (sure.right >= least)
    count = int(accepted.sum())
    if not count:
        return Estimate(torch.inf, 0, 0.0, 0.0, 0.0)
    if not sure.right.any():
        return Estimate(float(least), count, 1.0, None, None)
    doubts = 1 - sure.right[accepted].double()
    wrong = float(doubts.mean())
    by_chance = doubts * (1 - doubts) * sure.together[accepted] / count
    ends = _beta(wrong, float(sure.spread[accepted].mean()) ** 2 + float(by_chance.mean()))
    low, high = math.floor(ends[0] * count) / count, math.ceil(ends[1] * count) / count
    interval = (low, high) if high - low <= _NOTHING else (None, None)
    return Estimate(float(least), count, wrong, *interval)


def accept(sure: Confidence, max_wrong: float) -> Estimate:
    """The estimate that accepts most answers while it is at most ``max_wrong``, 0 to 1; none if an
    interval would say nothing."""
    order = sure.right[answered(sure)].double().sort(descending=True).values
    permitted = (1 - order).cumsum(0) <= max_wrong * torch.arange(1, len(order) + 1)
    last = torch.ones_like(permitted)
    last[:-1] = order[1:] < order[:-1]
    chosen = (permitted & last).nonzero()[:, 0]
    most = estimate(sure, float(order[chosen[-1]]) if len(chosen) else torch.inf)
    return estimate(sure, torch.inf) if most.low is None else most


def answered(sure: Confidence) -> Tensor:
    """``(Q,)`` bool, whether a query has a candidate."""
    return sure.together > 0


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
        math.exp(-_FAR * size * share - scale) / (size * share) for share in (mean, 1 - mean)
    )
    below = (before + inside) / (before + float(inside[-1]) + after)
    ends = torch.cat((torch.zeros(1), torch.sigmoid(logits[1:]), torch.ones(1)))
    quantiles = torch.tensor([0.025, 0.975], dtype=torch.double)
    low, high = ends[torch.searchsorted(below, quantiles)].tolist()
    return low, high


_TINY, _FAR = 1e-6, 15.0
