"""What the core computes from descriptors to decisions, as formulas: whole matrices, float64."""

import itertools
import math
from functools import cache
from itertools import product
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from ssrvlad_torch.recognition.standardise import sharing

MIN_FRAMES = 30
"""Of a sequence that has a mean of its own and shows which channel leads."""
NEAR, ELSEWHERE = 3, 5
"""Rows at most so far apart show the same place, and rows farther apart different places."""
ROUNDING, MIN_SPREAD, MAX_LOG = 1e-6, 1e-6, 50.0
SAMPLE = 200
"""Queries that show what leads; if there are more, every so many."""
EQUAL = 1e-6
"""A vector this near to the mean equals it: its sequence has one frame, or all are equal."""
LEAST_LENGTH, LEAST_TOTAL = 1e-3, float(np.finfo(np.float32).tiny)
FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""

# --------------------------------------------------------------------------- scores


def means_of_drives(numbers, sequences):
    """``(N, ...)``, what is subtracted from each frame: the mean of its drive, or of the drives
    that share one, see `sharing`. Frames of zeros do not count."""
    means, rows = np.zeros(numbers.shape), range(len(numbers))
    drives = [[*run] for _, run in itertools.groupby(rows, sequences.__getitem__)]
    for group, drives_of_mean in sharing([*map(len, drives)]).items():
        own, every = (
            [*itertools.chain.from_iterable(drives[number] for number in numbers_of)]
            for numbers_of in (group, drives_of_mean)
        )
        known = numbers[every][numbers[every].reshape(len(every), -1).any(1)]
        means[own] = known.mean(0) if len(known) else 0
    return means


def cosines(queries, references):
    """``(Q, R)`` by vectors ``(Q, D)`` and ``(R, D)``, -inf where one is zero."""
    lengths = np.outer(*(np.linalg.norm(each, axis=1) for each in (queries, references)))
    products = queries.astype(np.float64) @ references.T
    return np.where(lengths > 0, products / np.where(lengths > 0, lengths, 1), -np.inf)


def cosines_of_signs(queries, references, reach):
    """``(Q, R)`` by numbers ``(N, columns, D)``, signs as 1 and -1 or without a mean: those of the
    best move of a query by up to ``reach`` columns, over the columns that overlap."""
    best = np.full((len(queries), len(references)), -np.inf)
    columns = queries.shape[1]
    for move in range(-reach, reach + 1):
        ours = queries[:, max(0, -move) : columns - max(0, move)].reshape(len(queries), -1)
        theirs = references[:, max(0, move) : columns - max(0, -move)].reshape(len(references), -1)
        lengths = np.outer(*(np.linalg.norm(each, axis=1) for each in (ours, theirs)))
        best = np.maximum(best, ours @ theirs.T / np.maximum(lengths, LEAST_LENGTH))
    return np.minimum(best, 1)


def without_means(vectors, sequences, means=None):
    """Vectors ``(N, D)`` less the means of their drives, or less given ones; zeros stay, and what
    equals its mean stays as it is."""
    means = means_of_drives(vectors, sequences) if means is None else means
    less = vectors.any(1, keepdims=True) & (np.abs(vectors - means).max(1, keepdims=True) > EQUAL)
    return np.where(less, vectors - means, vectors)


def nearness(scores):
    """Minus the logarithm of 1 - cosine; -inf for -inf."""
    return -np.log(np.maximum(1 - scores.astype(np.float64), ROUNDING))


def z_scores(scores):
    """Of the nearness of scores ``(R,)``: how many deviations each is above the mean, 0 where there
    is none; the mean and the deviation."""
    known = np.isfinite(scores)
    near = np.where(known, nearness(np.where(known, scores, 0)), 0)
    count = max(1, np.count_nonzero(known))
    mean = near.sum() / count
    centred = np.where(known, near - mean, 0)
    deviation = math.sqrt(np.square(centred).sum() / count)
    return centred / max(deviation, MIN_SPREAD), float(mean), deviation


def lead(scores):
    """How many deviations, as for `z_scores`, the nearest row is ahead of the nearest elsewhere."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    z, _, _ = z_scores(scores)
    elsewhere = np.abs(np.arange(len(z)) - z.argmax()) > ELSEWHERE
    return float(z.max() - z[elsewhere].max())


def sampled(queries):
    """The queries that show what leads, see `SAMPLE`."""
    return queries[:: max(1, len(queries) // SAMPLE)]


def weights_of(channels, trust):
    """The weight of each channel by its scores ``(Q, R)`` of a drive: its trust, times the mean
    lead of its first candidates, for `SAMPLE` queries, if there are `MIN_FRAMES` and one leads."""
    known = {name: trust.get(name, 1.0) for name in channels}
    leads = {
        name: max(0.0, float(np.mean([lead(row) for row in sampled(scores)])))
        for name, scores in channels.items()
        if len(scores) >= MIN_FRAMES
    }
    if any(leads.values()):
        known = {name: known[name] * leads[name] for name in known}
    return {name: weight / sum(known.values()) for name, weight in known.items()}


def fused(channels, weights):
    """``(R,)`` scores of a query by all channels as one, as cosines: the weighted z-score, with the
    weighted mean and deviation; -inf where no channel has a score."""
    parts = {name: z_scores(scores) for name, scores in channels.items()}
    z, mean, deviation = (
        sum(weights[name] * part for name, part in zip(parts, each, strict=True))
        for each in zip(*parts.values(), strict=True)
    )
    some = np.isfinite([*channels.values()]).any(axis=0)
    return np.where(some, 1 - np.exp(-(mean + deviation * z)), -np.inf)


# ------------------------------------------------------------------------- sequences

SPEEDS = (
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.16, {0: 0.5, 1: 0.5}),
    (0.34, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.16, {1: 0.5, 2: 0.5}),
    (0.14, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""Probability of each speed, and of its steps in rows: 0, 1/2, 1, 3/2, 2, 3, 4 rows a frame."""


class Motion(NamedTuple):
    """How a sequence is expected to move, and how much one frame counts: the probability that its
    speed changes, of a jump to any row or to a place that the map lacks, the part of the latter, of
    staying at such places; the factor of a z-score in the logarithm of the emission, and the
    z-score above which a frame is more likely at a row than at a new place; mean steps a frame."""

    change: float = 0.05
    jump: float = 0.01
    unmapped: float = 0.1
    stay: float = 0.97
    weight: float = 0.3
    level: float = 0.5
    rate: float = 1

    def at(self, rate):
        """The same motion at another rate."""
        change, jump = (min(1.0, chance * rate) for chance in (self.change, self.jump))
        return self._replace(rate=rate, change=change, jump=jump, weight=self.weight * rate)


def steps_of(speed, rate):
    """The probability of each step in rows at a speed, by its number in `SPEEDS`."""
    steps, whole = {0: 1.0}, math.floor(rate)
    for likely in [1.0] * whole + [rate - whole] * (rate > whole):
        after = {far: (1 - likely) * chance for far, chance in steps.items()}
        for (far, chance), (step, part) in product(steps.items(), SPEEDS[speed][1].items()):
            after[far + step] = after.get(far + step, 0.0) + chance * part * likely
        steps = {far: chance for far, chance in after.items() if chance > 0}
    return steps


def emission(scores, motion):
    """How much likelier a query is at each row than at a place that the map lacks, ``(R,)``."""
    z, _, deviation = z_scores(scores)
    if deviation <= MIN_SPREAD:
        return np.ones(len(scores))
    told = np.exp(np.minimum(motion.weight * (z - motion.level), MAX_LOG))
    return np.where(np.isfinite(scores), told, 0)


class Model(NamedTuple):
    """A hidden Markov model of a drive along the rows of a map.

    A state is a speed and a row; the last one is a place that the map lacks. States are an array
    ``(7 * R + 1,)``: the rows at the first speed, at the second, and so on.
    """

    sequences: tuple
    motion: Motion
    way: int

    @property
    def rows(self):
        """The number of rows."""
        return len(self.sequences)

    def enter(self):
        """The probabilities of all states at any row; none of a map without rows."""
        speeds = [chance for chance, _ in SPEEDS]
        return np.append(np.repeat(speeds, self.rows) / max(1, self.rows), 0.0)

    def start(self):
        """The probabilities of all states before the first query."""
        unmapped = self.motion.unmapped if self.rows else 1.0
        states = (1 - unmapped) * self.enter()
        states[-1] = unmapped
        return states

    def targets(self, step):
        """The rows from which a step stays in its sequence, and where it leads."""
        rows, names = np.arange(self.rows), np.asarray(self.sequences)
        there = rows + self.way * step
        rows, there = (each[(there >= 0) & (there < self.rows)] for each in (rows, there))
        same = names[rows] == names[there] if len(rows) else rows > 0
        return rows[same], there[same]

    def after(self, states):
        """The probabilities of all states one query later. The speed changes, then a step of the
        new speed is taken. What jumps or leaves its sequence is lost: it enters anywhere."""
        motion, unmapped = self.motion, states[-1]
        before = states[:-1].reshape(len(SPEEDS), -1)
        moved = np.zeros_like(before)
        for speed, (chance, _) in enumerate(SPEEDS):
            turned = motion.change * chance * before.sum(0) + (1 - motion.change) * before[speed]
            for step, part in steps_of(speed, motion.rate).items():
                here, there = self.targets(step)
                moved[speed, there] += (1 - motion.jump) * part * turned[here]
        lost = before.sum() - moved.sum()
        later = np.append(moved.flatten(), motion.stay * unmapped + motion.unmapped * lost)
        return later + self.enter() * ((1 - motion.unmapped) * lost + (1 - motion.stay) * unmapped)

    def before(self, future):
        """How likely the later queries are from each state, by how likely they are from the states
        one query later: the transpose of `after`."""
        motion, unmapped = self.motion, future[-1]
        anywhere = self.enter() @ future
        lost = (1 - motion.unmapped) * anywhere + motion.unmapped * unmapped
        later = future[:-1].reshape(len(SPEEDS), -1)
        reached = np.full_like(later, lost)
        for speed in range(len(SPEEDS)):
            for step, part in steps_of(speed, motion.rate).items():
                here, there = self.targets(step)
                reached[speed, here] += part * (later[speed, there] - lost)
        any_speed = np.array([chance for chance, _ in SPEEDS]) @ reached
        turned = motion.change * any_speed + (1 - motion.change) * reached
        moved = (1 - motion.jump) * turned + motion.jump * lost
        return np.append(moved.flatten(), motion.stay * unmapped + (1 - motion.stay) * anywhere)

    def updated(self, belief, emission_of):
        """The belief after a query, and how much likelier the query is so than alone, as a
        logarithm. After a query that can be nowhere by the belief, this starts anew."""
        alone = (self.start() * emission_of).sum()
        if (belief * emission_of).sum() < LEAST_TOTAL:
            belief = self.start()
        total = (belief * emission_of).sum()
        if total < LEAST_TOTAL:
            return belief, 0.0
        return belief * emission_of / total, math.log(total / alone)

    def emissions(self, scores):
        """The likelihood of each query ``(Q, R)`` in all states."""
        return [np.append(np.tile(emission(row, self.motion), len(SPEEDS)), 1.0) for row in scores]


def follow(scores, sequences, motion, way, later):
    """Of each query ``(Q, R)`` probabilities of the rows, and ``(Q,)`` of a place that the map
    lacks, given all earlier queries and so many later ones: forward-backward."""
    model = Model(sequences, motion, way)
    emissions = model.emissions(scores)
    beliefs = []
    for emission_of in emissions:
        before = model.after(beliefs[-1]) if beliefs else model.start()
        beliefs.append(model.updated(before, emission_of)[0])
    none, count = np.ones(len(model.start())), len(emissions)
    futures = [none]
    for query in reversed(range(count - 1)):
        if query + later >= count - 1:  # all later queries
            ahead = [(futures[-1], emissions[query + 1])]
        else:
            ahead = [(none, each) for each in emissions[query + later : query : -1]]
        future = ahead[0][0] if ahead else none
        for _, each in ahead:
            future = model.before(future * each)
            future = future / future.max() if future.max() >= LEAST_TOTAL else none
        futures.append(future)
    both = [belief * future for belief, future in zip(beliefs, reversed(futures), strict=False)]
    possible = [
        product if product.sum() >= LEAST_TOTAL else belief
        for product, belief in zip(both, beliefs, strict=True)
    ]
    states = np.reshape([state / state.sum() for state in possible], (count, len(none)))
    return states[:, :-1].reshape(count, len(SPEEDS), -1).sum(1), states[:, -1]


def gain(scores, sequences, motion, way):
    """How much likelier the queries are as a drive than each alone, as a logarithm."""
    model, total = Model(sequences, motion, way), 0.0
    belief = model.start()
    for number, now in enumerate(model.emissions(scores)):
        belief, gained = model.updated(model.after(belief) if number else belief, now)
        total += gained
    return total


# ------------------------------------------------------------------------- how sure

PLACES = 10
"""Most places that are compared."""
ROWS_A_PLACE = 8.5
"""Mean distance of places: the best rows, each farther than `ELSEWHERE` from all better ones, of
maps of 60 to 600 rows are 8.2 to 9.1 rows apart."""
LEAST_STEP = 1e-4
"""Rivals that are nearer to one another are level: rounding is not to tell them apart."""


def chance(values, rows=None, matching=None):
    """The probability that a wrong answer is as far ahead of its rivals as the best of values
    ``(N,)`` is, -inf where there is none; and the row of the best rival, -1 without one. ``rows``
    are those of the map, by default the first ones; ``matching`` is how many of them could match,
    by default those with a value.

    The rivals of an answer are the best places elsewhere. If the answer is wrong, it is a chance
    place among chance places. Of n independent normal values the steps from each to the next lower
    one, divided by what they are on average, are nearly exponential with one scale (Renyi, 1953):
    if ``s`` is that of the answer over its best rival, and ``rest`` the sum of the m steps below,
    then ::

        chance = (1 + s / rest) ** -m

    is uniform from 0 to 1, whatever mean and deviation the values have, and nearly so of values
    that are nearly normal. The means of the steps are those of normal order statistics (Blom,
    1958). Nothing but `ROWS_A_PLACE` is measured.
    """
    at = np.arange(len(values)) if rows is None else np.asarray(rows)
    near = dict(zip(at.tolist(), values.astype(np.float64), strict=True))
    peaks = [
        row
        for row, value in near.items()
        if value > -np.inf and not any(near.get(row + aside, -np.inf) > value for aside in (-1, 1))
    ]
    best: list[int] = []
    for row in sorted(peaks, key=lambda row: -near[row]):
        if len(best) < PLACES and all(abs(row - other) > ELSEWHERE for other in best):
            best.append(row)
    rival = best[1] if len(best) > 1 else -1
    places = (np.isfinite(values).sum() if matching is None else matching) / ROWS_A_PLACE
    heights = np.array([near[row] for row in best])
    steps = -np.diff(heights)[: max(0, int(places) - 1)]
    if len(steps) < 2:
        return 1.0, rival
    ahead, *below = steps / mean_steps(places)[: len(steps)]
    return float((1 + ahead / max(sum(below), LEAST_STEP)) ** -len(below)), rival


def mean_steps(places):
    """The mean steps between the highest of so many normal values (Blom, 1958)."""
    ranks = np.arange(1, min(PLACES, int(places)) + 1)
    means = [NormalDist().inv_cdf(1 - (rank - 0.375) / (places + 0.25)) for rank in ranks]
    return -np.diff(means)


def answers_together(rivals):
    """How many neighbouring queries have one answer, by the best rivals ``(Q,)`` of a drive: the
    mean over the queries of the length of their run, whose rows are at most `NEAR` apart. It is the
    design effect of a sample in clusters (Kish, Survey Sampling, 1965)."""
    apart = np.flatnonzero(np.abs(np.diff(rivals)) > NEAR) + 1
    lengths = [len(run) for run in np.split(np.asarray(rivals), apart)]
    return sum(length * length for length in lengths) / len(rivals) if len(rivals) else 1.0


SLOPE, DEVIATION, SHAPES = 0.25, 0.6, (1.0, 2.0)
"""Of the gamma density of right answers: the median of its rate, the deviation of the logit of the
rate, and the shapes. With the first shape more right answers look like chance than with the second:
which is true, chances do not show."""
FRACTIONS, RATES, REACH = 15, 11, 2.5
"""Of the grid for the fraction of wrong answers and for the rate, and its reach in deviations."""


@cache
def prior():
    """Points of the prior: the fraction of wrong answers where the map has the places, rate and
    shape of the gamma density of right ones, and the weight."""
    away = np.linspace(-REACH, REACH, RATES)
    weights = np.exp(-np.square(away) / 2)
    rates = 1 / (1 + np.exp(math.log(1 / SLOPE - 1) - DEVIATION * away))
    fractions = (np.arange(FRACTIONS) + 0.5) / FRACTIONS
    each = weights / weights.sum() / (FRACTIONS * len(SHAPES))
    return [
        (float(wrong), float(rate), shape, float(weight))
        for wrong in fractions
        for rate, weight in zip(rates, each, strict=True)
        for shape in SHAPES
    ]


FOREIGN = 0.1
"""Prior probability that the map lacks the place of the first query."""
STRETCH = 200
"""Mean number of queries between places that the map has and places that it lacks."""


def mapped(chances, together, best=1.0):
    """The probability ``(Q,)`` that the map has the place of each query of a drive, by the chance
    of its answer by this query alone, NaN without one: the mean over the prior, each point weighed
    by how likely it makes all chances; queries that err together count as one. 0 without an answer.

    ``best`` is how often a wrong answer is the best of its query, always if it was judged alone; if
    not, the chance of an answer is 1 where it is not the best. That speaks against the map as far
    as other answers of the drive are the best, never for it."""
    known, found = ~np.isnan(chances), np.zeros(len(chances))
    is_best = (chances[known] < 1) | (best == 1)
    logs, each = [], []
    for weight, wrong, likelier in at_points(chances[known]):
        told = wrong + likelier / best
        if best < 1:
            told[~is_best] = min(1, wrong / (1 - best))
        likely, where = in_stretches(told ** (1 / together))
        logs.append(math.log(weight) + likely)
        each.append(where)
    found[known] = of_points(logs) @ each
    return found


FEW = 2
"""Of the density (1 - f) ** FEW of the fraction f of wrong answers where the map has the places, of
a sequence that is followed: one that fits is seldom wrong. Judged alone any f is as likely."""


def confidence(chances, mapped, together, followed=False):
    """Of each answer of a drive the probability that it is right and its standard deviation, by its
    chance ``(Q,)``, NaN without an answer, and the probability that the map has its place: that
    times the mean over the prior, each point weighed by how likely it makes the chances where the
    map has the places; queries that err together count as one. The deviation is that of answers
    whose places the map has all together or not at all. See `confidence`."""
    right, spread, known = np.zeros(len(chances)), np.zeros(len(chances)), ~np.isnan(chances)
    logs, rights = [], []
    for weight, wrong, likelier in at_points(chances[known]):
        told = wrong + likelier
        logs.append(math.log(weight) + float((mapped[known] * np.log(told)).sum()) / together)
        logs[-1] += FEW * math.log(1 - wrong) if followed else 0
        rights.append(likelier / told)
    weights = of_points(logs)
    right[known] = mapped[known] * (weights @ rights)
    square = mapped[known] * (weights @ np.square(rights))
    spread[known] = np.sqrt(np.maximum(0, square - right[known] ** 2))
    return right, spread


def at_points(chances):
    """Of each point of the prior the weight, the fraction of wrong answers, and how much likelier
    each answer is as one of the right ones than as any where the map lacks the place."""
    ahead = -np.log(np.clip(chances, math.exp(-20), 1 - 1e-3))
    for wrong, r, k, weight in prior():
        log = k * math.log(r) - math.lgamma(k) + (k - 1) * np.log(ahead) + (1 - r) * ahead
        yield weight, wrong, (1 - wrong) * np.exp(log)


def of_points(logs):
    """Weights of the sum 1, by their logarithms."""
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    return weights


def in_stretches(told):
    """The logarithm of how likely queries are, each ``told (Q,)`` times as likely where the map has
    its place as where it lacks it, and ``(Q,)`` the probability that it has the place. Both kinds
    of stretches last `STRETCH` queries in the mean: forward-backward."""
    stay = 1 - 1 / STRETCH
    change = np.array([[stay, 1 - stay], [1 - stay, stay]])
    each = np.stack([told, np.ones(len(told))], axis=1)
    before, future, log = np.array([1 - FOREIGN, FOREIGN]), np.ones(2), 0.0
    beliefs, found = np.zeros((len(told), 2)), np.zeros(len(told))
    for query in range(len(told)):
        belief = each[query] * before
        log += math.log(belief.sum())
        beliefs[query] = belief = belief / belief.sum()
        before = change @ belief
    for query in reversed(range(len(told))):
        both = beliefs[query] * future
        found[query] = both[0] / both.sum()
        future = change @ (each[query] * future)
        future /= future.sum()
    return log, found
