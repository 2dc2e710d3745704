"""What the core computes from descriptors to decisions, as formulas: whole matrices, float64."""

import itertools
import math
from functools import cache
from statistics import NormalDist

import numpy as np
from oracles.filter import LEAST_TOTAL, MAX_LOG, MIN_SPREAD, NUMBERS, Model

from ssrvlad_torch.recognition.sequences import sharing

MIN_FRAMES, SAMPLE = int(NUMBERS["min_frames"]), int(NUMBERS["compared"])
SAME_PLACE_ROWS, ELSEWHERE = int(NUMBERS["near"]), int(NUMBERS["elsewhere"])
ROUNDING = 1e-6
EQUAL = 1e-6
"""A vector this near to the mean equals it: its sequence has one frame, or all are equal."""
LEAST_LENGTH = 1e-3

# --------------------------------------------------------------------------- scores


def means_of_sequences(numbers, sequences):
    """``(N, ...)``, what is subtracted from each frame: the mean of its sequence, or of those that
    share one, see `sharing`. Frames of zeros do not count."""
    means = np.zeros(numbers.shape)
    lengths = [len([*frames]) for _, frames in itertools.groupby(sequences)]
    number = np.repeat(np.arange(len(lengths)), lengths)
    for group, shared in sharing(lengths).items():
        frames = numbers[np.isin(number, shared)]
        frames = frames[frames.reshape(len(frames), -1).any(1)]
        means[np.isin(number, group)] = frames.mean(0) if len(frames) else 0
    return means


def cosines(queries, references):
    """``(Q, R)`` by vectors ``(Q, D)`` and ``(R, D)``, -inf where one is zero."""
    lengths = np.outer(*(np.linalg.norm(side, axis=1) for side in (queries, references)))
    products = queries.astype(np.float64) @ references.T
    return np.where(lengths > 0, products / np.where(lengths > 0, lengths, 1), -np.inf)


def cosines_of_signs(queries, references, across, down):
    """``(Q, R)`` by numbers ``(N, columns, rows, bits)``, signs as 1 and -1 or without a mean:
    those of the best move of a query, by up to so many columns to each side and rows up and down,
    over the cells that overlap."""
    best = np.full((len(queries), len(references)), -np.inf)
    for move in itertools.product(range(-across, across + 1), range(-down, down + 1)):
        sides = []
        for side, sign in ((queries, -1), (references, 1)):
            firsts = [max(0, sign * cells) for cells in move]
            counts = [n - abs(cells) for n, cells in zip(side.shape[1:3], move, strict=True)]
            within = [slice(a, a + n) for a, n in zip(firsts, counts, strict=True)]
            overlap = side[:, *within]
            sides.append(overlap.reshape(len(side), -1))
        lengths = np.outer(*(np.linalg.norm(side, axis=1) for side in sides))
        best = np.maximum(best, sides[0] @ sides[1].T / np.maximum(lengths, LEAST_LENGTH))
    return np.minimum(best, 1)


def without_means(vectors, sequences):
    """Vectors ``(N, D)`` less the means of their sequences; zeros stay, and what equals its mean
    stays as it is."""
    means = means_of_sequences(vectors, sequences)
    less = vectors.any(1, keepdims=True) & (np.abs(vectors - means).max(1, keepdims=True) > EQUAL)
    return np.where(less, vectors - means, vectors)


def nearness(scores):
    """Minus the logarithm of 1 - cosine; -inf for -inf."""
    return -np.log(np.maximum(1 - scores.astype(np.float64), ROUNDING))


def z_scores(scores, rows=None):
    """Of the nearness of scores ``(R,)``: how many deviations each is above the mean of all or of
    the first rows, 0 where there is none; the mean and the deviation."""
    near = nearness(scores)
    usual = near[:rows][np.isfinite(near[:rows])]
    mean, deviation = (float(usual.mean()), float(usual.std())) if len(usual) else (0.0, 0.0)
    centred = np.where(np.isfinite(near), near - mean, 0)
    return centred / max(deviation, MIN_SPREAD), mean, deviation


def lead(scores):
    """How many deviations, as for `z_scores`, the nearest row is ahead of the nearest elsewhere."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    z, _, _ = z_scores(scores)
    elsewhere = np.abs(np.arange(len(z)) - z.argmax()) > ELSEWHERE
    return float(z.max() - z[elsewhere].max())


def weights_of(channels, trust):
    """The weight of each channel by its scores ``(Q, R)`` of a sequence: its trust, times the mean
    lead of its first candidates, for `SAMPLE` queries, if there are `MIN_FRAMES` and one leads."""
    weights = {name: trust.get(name, 1.0) for name in channels}
    leads = {
        name: max(0.0, np.mean([lead(row) for row in scores[:: max(1, len(scores) // SAMPLE)]]))
        for name, scores in channels.items()
        if len(scores) >= MIN_FRAMES
    }
    if any(leads.values()):
        weights = {name: weight * leads[name] for name, weight in weights.items()}
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def fused(channels, weights, rows=None):
    """``(R,)`` scores of a query by all channels as one, as cosines: the weighted z-score, with the
    weighted mean and deviation; -inf where no channel has a score."""
    scaled = [z_scores(scores, rows) for scores in channels.values()]
    z, mean, deviation = (
        sum(weight * number for weight, number in zip(weights.values(), numbers, strict=True))
        for numbers in zip(*scaled, strict=True)
    )
    seen = np.isfinite([*channels.values()]).any(axis=0)
    return np.where(seen, 1 - np.exp(-(mean + deviation * z)), -np.inf)


# ------------------------------------------------------------------------- sequences


def emission(scores, motion):
    """How much likelier a query is at each row than at a place that the map lacks, ``(R,)``."""
    z, _, deviation = z_scores(scores)
    if deviation <= MIN_SPREAD:
        return np.ones(len(scores))
    likelier = np.exp(np.minimum(motion.weight * (z - motion.level), MAX_LOG))
    return np.where(np.isfinite(scores), likelier, 0)


def emissions(model, scores):
    """The emission of each query ``(Q, R)`` in all states."""
    return [model.emission(emission(row, model.motion)) for row in scores]


def follow(scores, sequences, motion, way):
    """Of each query ``(Q, R)`` probabilities of the rows, given all queries: forward-backward."""
    model = Model(tuple(sequences), motion, (way,))
    beliefs, seen = [], emissions(model, scores)
    for now in seen:
        before = model.after(beliefs[-1]) if beliefs else model.start()
        beliefs.append(model.updated(before, now)[0])
    none = np.ones(len(model.start()))
    futures = [none]
    for now in seen[:0:-1]:
        future = model.before(futures[-1] * now)
        futures.append(future / future.max() if future.max() >= LEAST_TOTAL else none)
    both = [belief * future for belief, future in zip(beliefs, futures[::-1], strict=True)]
    possible = [
        states if states.sum() >= LEAST_TOTAL else belief
        for states, belief in zip(both, beliefs, strict=True)
    ]
    return [model.rows(states / states.sum()) for states in possible]


def gain(scores, sequences, motion, way):
    """How much likelier the queries are as a sequence than each alone, as a logarithm."""
    model, total = Model(tuple(sequences), motion, (way,)), 0.0
    belief = model.start()
    for number, now in enumerate(emissions(model, scores)):
        belief, gained = model.updated(model.after(belief) if number else belief, now)
        total += gained
    return total


# ------------------------------------------------------------------------- how sure

PLACES, ROWS_A_PLACE = int(NUMBERS["most_places"]), NUMBERS["rows_a_place"]
LEAST_STEP = NUMBERS["rounding"]


def chance(values):
    """The probability that a wrong answer is as far ahead of its rivals as the best of values
    ``(R,)`` is, -inf where there is none; and the row of the best rival, -1 without one.

    If the answer is wrong, it is a chance place among chance places. Of independent normal values
    the steps from each to the next lower one, divided by their means, are nearly exponential with
    one scale (Renyi, 1953): of the step ``s`` over the best rival, and the sum ``below`` of the m
    further steps, ``(1 + s / below) ** -m`` is uniform from 0 to 1, whatever the scale.
    """
    padded = np.pad(values.astype(np.float64), 1, constant_values=-np.inf)
    beside = np.maximum(padded[:-2], padded[2:])
    peaks = np.flatnonzero((values > -np.inf) & (values >= beside))
    best = []
    for row in sorted(peaks.tolist(), key=lambda row: -values[row]):
        if len(best) < PLACES and all(abs(row - other) > ELSEWHERE for other in best):
            best.append(row)
    rival = best[1] if len(best) > 1 else -1
    places = np.isfinite(values).sum() / ROWS_A_PLACE
    steps = -np.diff(values[best].astype(np.float64))[: max(0, int(places) - 1)]
    if len(steps) < 2:
        return 1.0, rival
    ahead, *below = steps / mean_steps(places)[: len(steps)]
    return float((1 + ahead / max(sum(below), LEAST_STEP)) ** -len(below)), rival


def mean_steps(places):
    """The mean steps between the highest of so many normal values (Blom, 1958)."""
    ranks = np.arange(1, min(PLACES, int(places)) + 1)
    means = [NormalDist().inv_cdf(1 - (rank - 0.375) / (places + 0.25)) for rank in ranks]
    return -np.diff(means)


def rivals_together(chances, rivals):
    """How many neighbouring queries have the best rival ``(Q,)`` of each: the length of their run,
    whose rows are at most `SAME_PLACE_ROWS` apart; 0 where the chance is NaN. The mean over the
    answers is the design effect of a sample in clusters (Kish, Survey Sampling, 1965)."""
    answered, together = np.flatnonzero(~np.isnan(chances)), np.zeros(len(chances))
    apart = np.flatnonzero(np.abs(np.diff(np.asarray(rivals)[answered])) > SAME_PLACE_ROWS) + 1
    for run in np.split(answered, apart):
        together[run] = len(run)
    return together


def answers_together(together):
    """How many neighbouring queries have one answer, by `rivals_together`."""
    return together[together > 0].mean() if together.any() else 1.0


SLOPE, DEVIATION, SHAPES = 0.25, 0.6, (1.0, 2.0)
"""Of the gamma density of right answers: the median of its rate, the deviation of the logit of the
rate, and the shapes. With the first shape more right answers look like chance than with the second:
which is true, chances do not show."""
POINTS, REACH = int(NUMBERS["points"]), NUMBERS["most_away"]
"""Of the grids of the prior, and the reach of that of the rate, in deviations."""


@cache
def prior():
    """Points of the prior: the fraction of wrong answers where the map has the places, rate and
    shape of the gamma density of right ones, and the weight."""
    away = np.linspace(-REACH, REACH, POINTS)
    weights = np.exp(-np.square(away) / 2)
    rates = 1 / (1 + np.exp(math.log(1 / SLOPE - 1) - DEVIATION * away))
    fractions = (np.arange(POINTS) + 0.5) / POINTS
    weights /= weights.sum() * POINTS * len(SHAPES)
    at_rates = [*zip(rates, weights, strict=True)]
    return [
        (wrong, rate, shape, weight)
        for wrong, (rate, weight), shape in itertools.product(fractions, at_rates, SHAPES)
    ]


def mapped(chances, together):
    """The probability ``(Q,)`` that the map has the place of each query of a drive, by the chance
    of its answer by this query alone, NaN without one: the mean over the prior, each point weighed
    by how likely it makes all chances; queries that err together count as one. 0 without one."""
    points = at_points(chances[~np.isnan(chances)])
    weighed = [(weight, (wrong + likelier) ** (1 / together)) for weight, wrong, likelier in points]
    return mean_of_points(weighed, chances)


MOST_NEARER = NUMBERS["most_nearer"]
CHANCE_NEARER, LEAST_TOGETHER = NUMBERS["chance_nearer"], NUMBERS["least_together"]


def mapped_along(nearer, together):
    """The same of a sequence that is followed, by how many deviations the place of each answer is
    nearer to its query than all rows in the mean, NaN without one. It is normal, of deviation 1,
    about `CHANCE_NEARER` where the map lacks the place, else about a level that is as high or
    higher; queries that have one rival, at least `LEAST_TOGETHER`, count as one."""
    answered = ~np.isnan(nearer)
    values, lengths = nearer[answered], np.maximum(LEAST_TOGETHER, together[answered])
    ratios = [
        np.exp(
            np.minimum(((values - CHANCE_NEARER) ** 2 - (values - level) ** 2) / 2, MAX_LOG)
            / lengths
        )
        for level in CHANCE_NEARER + np.linspace(0, MOST_NEARER, POINTS)
    ]
    return mean_of_points([(1, ratio) for ratio in ratios], nearer)


def mean_of_points(points, numbers):
    """Of weights and how much likelier the queries that have a number are where the map has their
    place: the mean probability ``(Q,)`` that it has, each weighed by how likely it makes all."""
    answered, has = ~np.isnan(numbers), np.zeros(len(numbers))
    of_points = [(weight, *in_stretches(ratio)) for weight, ratio in points]
    logs = [math.log(weight) + log for weight, log, _ in of_points]
    has[answered] = normalised(logs) @ [states for _, _, states in of_points]
    return has


def confidence(chances, mapped, together, followed=False):
    """Of each answer of a drive the probability that it is right and its standard deviation, by its
    chance ``(Q,)``, NaN without an answer, and the probability that the map has its place: that
    times the mean over the prior, each point weighed by how likely it makes the chances where the
    map has the places; queries that err together count as one. The deviation is that of answers
    whose places the map has all together or not at all. See `confidence`."""
    right, spread, answered = np.zeros(len(chances)), np.zeros(len(chances)), ~np.isnan(chances)
    has, logs, rights = mapped[answered], [], []
    for weight, wrong, likelier in at_points(chances[answered]):
        ratio = wrong + likelier
        logs.append(math.log(weight) + float((has * np.log(ratio)).sum()) / together)
        logs[-1] += NUMBERS["few"] * math.log(1 - wrong) if followed else 0
        rights.append(likelier / ratio)
    weights = normalised(logs)
    right[answered] = has * (weights @ rights)
    square = has * (weights @ np.square(rights))
    spread[answered] = np.sqrt(np.maximum(0, square - right[answered] ** 2))
    return right, spread


def at_points(chances):
    """Of each point of the prior the weight, the fraction of wrong answers, and how much likelier
    each answer is as one of the right ones than as any where the map lacks the place."""
    ahead = -np.log(np.clip(chances, math.exp(-MAX_LOG), 1 - 1e-3))
    for wrong, r, k, weight in prior():
        log = k * math.log(r) - math.lgamma(k) + (k - 1) * np.log(ahead) + (1 - r) * ahead
        yield weight, wrong, (1 - wrong) * np.exp(log)


def normalised(logs):
    """Weights of the sum 1, by their logarithms."""
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    return weights


def in_stretches(ratio):
    """The logarithm of how likely queries are, each ``ratio (Q,)`` times as likely where the map
    has its place as where it lacks it, and ``(Q,)`` the probability that it has the place. Both
    kinds of stretches last `NUMBERS["stretch"]` queries in the mean: forward-backward."""
    stay = 1 - 1 / NUMBERS["stretch"]
    change = np.array([[stay, 1 - stay], [1 - stay, stay]])
    emissions = np.stack([ratio, np.ones(len(ratio))], axis=1)
    before, future, log = np.array([1 - NUMBERS["unmapped"], NUMBERS["unmapped"]]), np.ones(2), 0.0
    beliefs, smoothed = [], []
    for now in emissions:
        belief = now * before
        log += math.log(belief.sum())
        beliefs.append(belief / belief.sum())
        before = change @ beliefs[-1]
    for belief, now in zip(beliefs[::-1], emissions[::-1], strict=True):
        both = belief * future
        smoothed.append(both[0] / both.sum())
        future = change @ (now * future)
        future /= future.sum()
    return log, smoothed[::-1]
