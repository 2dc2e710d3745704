"""Reference: from descriptors to decisions plainly, in NumPy. The oracle of this room.

One channel after another is compared with the map, the scores are fused, the drive is followed by
a hidden Markov model, and each answer is held beside its rivals. Every step is written as its
formula says, with whole matrices and float64; all other forms are held to it by the tests.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..native.decide import Decision, Places
from .motion import (
    BACKWARDS,
    ELSEWHERE,
    FORWARDS,
    MAX_LOG,
    MIN_SPREAD,
    NEAR,
    ROUNDING,
    SPEEDS,
    Course,
    Motion,
    steps_of,
)
from .standardise import MIN_FRAMES, sharing

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

MOVES = 2
"""Columns by which signs are moved to each side."""
SAMPLE = 200
"""Queries that show what leads; if there are more, every so many."""
EQUAL = 1e-6
"""A vector this near to the mean equals it: its drive has one frame, or all frames are equal."""

_LEAST_LENGTH = 1e-3
_LEAST_TOTAL = float(np.finfo(np.float32).tiny)


def means_of_drives(numbers: Array, sequences: Sequence[str]) -> Floats:
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


def cosines(queries: Array, references: Array) -> Floats:
    """``(Q, R)`` by vectors ``(Q, D)`` and ``(R, D)``, -inf where one is zero."""
    lengths = np.outer(*(np.linalg.norm(each, axis=1) for each in (queries, references)))
    products = queries.astype(np.float64) @ references.T
    scores: Floats = np.where(lengths > 0, products / np.where(lengths > 0, lengths, 1), -np.inf)
    return scores


def cosines_of_signs(queries: Array, references: Array, reach: int) -> Floats:
    """``(Q, R)`` by numbers ``(N, columns, D)``, signs as 1 and -1 or without a mean: those of the
    best move of a query by up to ``reach`` columns, over the columns that overlap."""
    best = np.full((len(queries), len(references)), -np.inf)
    columns = queries.shape[1]
    for move in range(-reach, reach + 1):
        ours = queries[:, max(0, -move) : columns - max(0, move)].reshape(len(queries), -1)
        theirs = references[:, max(0, move) : columns - max(0, -move)].reshape(len(references), -1)
        lengths = np.outer(*(np.linalg.norm(each, axis=1) for each in (ours, theirs)))
        best = np.maximum(best, ours @ theirs.T / np.maximum(lengths, _LEAST_LENGTH))
    capped: Floats = np.minimum(best, 1)
    return capped


def without_means(vectors: Array, sequences: Sequence[str], means: Array | None = None) -> Floats:
    """Vectors ``(N, D)`` less the means of their drives, or less given ones; zeros stay, and what
    equals its mean stays as it is."""
    means = means_of_drives(vectors, sequences) if means is None else means
    less = vectors.any(1, keepdims=True) & (np.abs(vectors - means).max(1, keepdims=True) > EQUAL)
    found: Floats = np.where(less, vectors - means, vectors)
    return found


def compare_vectors(
    queries: Array,
    references: Array,
    sequences: Sequence[str],
    standardised: bool,
    sweep: bool,
    means: Array | None = None,
    mean: Array | None = None,
) -> tuple[Floats, int]:
    """``(Q, R)`` scores of the queries of one drive from S anchors ``(Q, S, D)``, by the best of
    them or by the middle one, against ``(R, D)``; and how many anchors to each side count. Of some
    queries of a drive, the ``mean`` of the drive is given, and all anchors count; of some rows, the
    ``means`` ``(R, D)`` of theirs."""
    middle = queries.shape[1] // 2
    enough = standardised and len(queries) >= MIN_FRAMES
    rows = without_means(references, sequences, means) if standardised else references
    widths, scores = range(middle + 1 if sweep else 1), list[Floats]()
    for width in widths if mean is None else widths[-1:]:
        part = queries[:, middle - width : middle + width + 1]
        if enough or mean is not None:
            every = part.reshape(-1, part.shape[2])
            part = without_means(every, [""] * len(every), mean).reshape(part.shape)
        scores.append(np.max([cosines(each, rows) for each in part.swapaxes(0, 1)], axis=0))
    if mean is not None:
        return scores[0], widths[-1]
    leads, best = [mean_lead(each) for each in scores], 0
    for width in widths:
        if leads[width] > leads[best] + WIDER:
            best = width
    return scores[best], best


WIDER = 1e-4
"""A wider sweep leads by more than rounding does."""


def mean_lead(scores: Array) -> float:
    """How much nearer the nearest row is than the nearest elsewhere, on average over a sample of
    the queries that have both."""
    rows = np.arange(scores.shape[1])
    if len(rows) <= 2 * ELSEWHERE + 1:
        return 0.0
    leads = []
    for each in sampled(scores):
        elsewhere = np.abs(rows - each.argmax()) > ELSEWHERE
        near = nearness(np.array([each.max(), each[elsewhere].max()]))
        leads.append(near[0] - near[1] if np.isfinite(near).all() else np.nan)
    return float(np.nanmean(leads)) if np.isfinite(leads).any() else 0.0


def compare_signs(
    queries: Array,
    references: Array,
    sequences: Sequence[str],
    standardised: bool,
    sweep: bool,
    means: Array | None = None,
    mean: Array | None = None,
) -> Floats:
    """``(Q, R)`` scores of the queries of one drive, signs ``(Q, columns, ...)`` uint8, against
    those of a map, by the best move or by none. A drive of equal frames keeps its mean. Means are
    given as for `compare_vectors`, ``(columns, bits)`` each."""
    sides = list[Array]()
    for signs, names, given in (
        (queries, [""] * len(queries), mean),
        (references, sequences, means if standardised else None),
    ):
        bits = np.unpackbits(signs.reshape(*signs.shape[:2], -1), axis=2, bitorder="little")
        side = 2.0 * bits - 1
        if standardised or given is not None:
            less = (
                means_of_drives(side, names)
                if given is None
                else given.reshape(-1, *side.shape[1:])
            )
            side -= np.where((np.abs(less) == 1).all((1, 2), keepdims=True), 0, less)
        sides.append(side)
    reach = min(MOVES, queries.shape[1] - 1) if sweep else 0
    return cosines_of_signs(sides[0], sides[1], reach)


def nearness(scores: Array) -> Floats:
    """Minus the logarithm of 1 - cosine; -inf for -inf."""
    return -np.log(np.maximum(1 - scores.astype(np.float64), ROUNDING))


EVERY = slice(None)


def z_scores(scores: Array, of: slice = EVERY) -> tuple[Floats, float, float]:
    """Of the nearness of scores ``(R,)``: how many deviations each is above the mean, 0 where there
    is none; the mean and the deviation, which are ``of`` some rows, by default of all."""
    known = np.isfinite(scores)
    near = np.where(known, nearness(np.where(known, scores, 0)), 0)
    count = max(1, np.count_nonzero(known[of]))
    mean = near[of].sum() / count
    centred = np.where(known, near - mean, 0)
    deviation = math.sqrt(np.square(centred[of]).sum() / count)
    return centred / max(deviation, MIN_SPREAD), float(mean), deviation


def lead(scores: Array, of: slice = EVERY) -> float:
    """How many deviations, as for `z_scores`, the nearest row is ahead of the nearest elsewhere."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    z, _, _ = z_scores(scores, of)
    elsewhere = np.abs(np.arange(len(z)) - z.argmax()) > ELSEWHERE
    return float(z.max() - z[elsewhere].max())


def sampled(queries: Array) -> Array:
    """The queries that show what leads, see `SAMPLE`."""
    return queries[:: max(1, len(queries) // SAMPLE)]


def weights_of(channels: Mapping[str, Array], trust: Mapping[str, float]) -> dict[str, float]:
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


def fused(channels: Mapping[str, Array], weights: Mapping[str, float], of: slice = EVERY) -> Floats:
    """``(R,)`` scores of a query by all channels as one, as cosines: the weighted z-score, with the
    weighted mean and deviation ``of`` some rows, by default of all; -inf where no channel has a
    score."""
    parts = {name: z_scores(scores, of) for name, scores in channels.items()}
    z, mean, deviation = (
        sum(weights[name] * part for name, part in zip(parts, each, strict=True))
        for each in zip(*parts.values(), strict=True)
    )
    some = np.isfinite([*channels.values()]).any(axis=0)
    return np.where(some, 1 - np.exp(-(mean + deviation * z)), -np.inf)


def likelihood(scores: Array, motion: Motion) -> Floats:
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

    sequences: Sequence[str]
    motion: Motion
    way: int

    @property
    def rows(self) -> int:
        """The number of rows."""
        return len(self.sequences)

    def enter(self) -> Floats:
        """The probabilities of all states at any row; none of a map without rows."""
        speeds = [chance for chance, _ in SPEEDS]
        return np.append(np.repeat(speeds, self.rows) / max(1, self.rows), 0.0)

    def start(self) -> Floats:
        """The probabilities of all states before the first query."""
        unmapped = self.motion.unmapped_at_start(self.rows)
        states = (1 - unmapped) * self.enter()
        states[-1] = unmapped
        return states

    def targets(self, step: int) -> tuple[Array, Array]:
        """The rows from which a step stays in its sequence, and where it leads."""
        rows, names = np.arange(self.rows), np.asarray(self.sequences)
        there = rows + self.way * step
        rows, there = (each[(there >= 0) & (there < self.rows)] for each in (rows, there))
        same = names[rows] == names[there] if len(rows) else rows > 0
        return rows[same], there[same]

    def after(self, states: Floats) -> Floats:
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
        found: Floats = later + self.enter() * (
            (1 - motion.unmapped) * lost + (1 - motion.stay) * unmapped
        )
        return found

    def before(self, future: Floats) -> Floats:
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

    def updated(self, belief: Floats, told: Floats) -> tuple[Floats, float]:
        """The belief after a query, and how much likelier the query is so than alone, as a
        logarithm. After a query that can be nowhere by the belief, this starts anew."""
        alone = (self.start() * told).sum()
        if (belief * told).sum() < _LEAST_TOTAL:
            belief = self.start()
        total = (belief * told).sum()
        if total < _LEAST_TOTAL:
            return belief, 0.0
        return belief * told / total, math.log(total / alone)

    def told(self, scores: Array) -> list[Floats]:
        """The likelihood of each query ``(Q, R)`` in all states."""
        return [
            np.append(np.tile(likelihood(row, self.motion), len(SPEEDS)), 1.0) for row in scores
        ]


def follow(
    scores: Array, sequences: Sequence[str], motion: Motion, way: int, later: int
) -> tuple[Floats, Floats]:
    """Of each query ``(Q, R)`` probabilities of the rows, and ``(Q,)`` of a place that the map
    lacks, given all earlier queries and so many later ones: forward-backward."""
    model = Model(sequences, motion, way)
    told = model.told(scores)
    beliefs = list[Floats]()
    for each in told:
        before = model.after(beliefs[-1]) if beliefs else model.start()
        beliefs.append(model.updated(before, each)[0])
    none, count = np.ones(len(model.start())), len(told)
    futures = [none]
    for query in reversed(range(count - 1)):
        if query + later >= count - 1:  # all later queries
            ahead = [(futures[-1], told[query + 1])]
        else:
            ahead = [(none, each) for each in told[query + later : query : -1]]
        future = ahead[0][0] if ahead else none
        for _, each in ahead:
            future = model.before(future * each)
            future = future / future.max() if future.max() >= _LEAST_TOTAL else none
        futures.append(future)
    found = [belief * future for belief, future in zip(beliefs, reversed(futures), strict=False)]
    found = [
        both if both.sum() >= _LEAST_TOTAL else belief
        for both, belief in zip(found, beliefs, strict=True)
    ]
    states = np.reshape([each / each.sum() for each in found], (count, len(none)))
    return states[:, :-1].reshape(count, len(SPEEDS), -1).sum(1), states[:, -1]


def gain(scores: Array, sequences: Sequence[str], motion: Motion, way: int) -> float:
    """How much likelier the queries are as a drive than each alone, as a logarithm."""
    model, total = Model(sequences, motion, way), 0.0
    belief = model.start()
    for number, told in enumerate(model.told(scores)):
        belief, gained = model.updated(model.after(belief) if number else belief, told)
        total += gained
    return total


PLACES = 10
"""Most places that are compared."""
ROWS_A_PLACE = 8.5
"""Mean distance of places: the best rows, each farther than `ELSEWHERE` from all better ones, of
maps of 60 to 600 rows are 8.2 to 9.1 rows apart."""
LEAST_STEP = 1e-4
"""Rivals that are nearer to one another are level: rounding is not to tell them apart."""


def chance(
    values: Array, rows: Array | None = None, matching: int | None = None
) -> tuple[float, int]:
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


def mean_steps(places: float) -> Floats:
    """The mean steps between the highest of so many normal values (Blom, 1958)."""
    ranks = np.arange(1, min(PLACES, int(places)) + 1)
    means = [NormalDist().inv_cdf(1 - (rank - 0.375) / (places + 0.25)) for rank in ranks]
    return -np.diff(means)


def answers_together(rivals: Array) -> float:
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
def prior() -> list[tuple[float, float, float, float]]:
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


def mapped(chances: Array, together: float, best: float = 1.0) -> Floats:
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


def confidence(
    chances: Array, mapped: Array, together: float, followed: bool = False
) -> tuple[Floats, Floats]:
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


def at_points(chances: Floats) -> Iterator[tuple[float, float, Floats]]:
    """Of each point of the prior the weight, the fraction of wrong answers, and how much likelier
    each answer is as one of the right ones than as any where the map lacks the place."""
    ahead = -np.log(np.clip(chances, math.exp(-20), 1 - 1e-3))
    for wrong, r, k, weight in prior():
        log = k * math.log(r) - math.lgamma(k) + (k - 1) * np.log(ahead) + (1 - r) * ahead
        yield weight, wrong, (1 - wrong) * np.exp(log)


def of_points(logs: list[float]) -> Floats:
    """Weights of the sum 1, by their logarithms."""
    weights: Floats = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    return weights


def in_stretches(told: Floats) -> tuple[float, Floats]:
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


COURSES = (Course(), Course(rate=3), Course(rate=0.25), Course(streams=2))
OF_TWO = 0.75
"""What counts of the gain of two streams: a slow one is hardly less likely as two in turn."""
LEAST_GAIN, UNUSUAL = 1.0, 3.0
"""The gain of a course, and how much more another than forwards at the rate of the map must have:
before anything is known, one drive in twenty takes it."""
BY_ROWS = 0.5
"""How much of its gain a drive may have in a random order. A row of the map that is like every
query gains all of it."""
DRIVE, MARGIN = 0.5, 0.05
"""The gain a query that only drives have, and a difference of mean confidences."""
AROUND = 10
"""Frames on each side that tell of an answer: so many a wrong one lasts in a followed sequence."""
BEST = 1 / 3
"""How often a wrong answer of a followed sequence is the best of its query alone."""
COMPARED = 512
"""Rows at most by whose scores queries are compared with one another."""
ALIKE = 1e-9
"""Likeness that rounding makes."""


def course(scores: Array, sequences: Sequence[str]) -> tuple[Course, float]:
    """How the queries of one drive run a map, if they do, and the gain a query, 0 if they do not:
    of all kinds and both ways the likeliest, by its gain; two streams need a third more gain than
    one. There is no course if there is hardly any gain, or if the queries gain it in a random order
    too.

    Gains a query: real drives and two streams in turn 0.3 to 1.0, three to six streams 0.03 to
    0.35, drives in foreign maps 0.05 to 0.4, random frames 0.0 to 0.1."""
    tried = [
        kind._replace(way=way) for kind, way in itertools.product(COURSES, (FORWARDS, BACKWARDS))
    ]
    gains = [gain_of(scores, sequences, each) for each in tried]
    likely = [each - UNUSUAL * (kind != Course()) for kind, each in zip(tried, gains, strict=True)]
    best = int(np.argmax(likely))
    if gains[best] <= LEAST_GAIN:
        return Course(), 0.0
    shuffled = scores[at_random(len(scores))]
    if gain_of(shuffled, sequences, tried[best]) > BY_ROWS * gains[best]:
        return Course(), 0.0
    return tried[best], gains[best] / len(scores)


def gain_of(scores: Array, sequences: Sequence[str], kind: Course) -> float:
    """What counts of the gain of queries by a course."""
    motion = Motion(unmapped=0.0, rate=kind.rate)
    streams = [scores[number :: kind.streams] for number in range(kind.streams)]
    total = sum(gain(stream, sequences, motion, kind.way) for stream in streams)
    return total * (1 if kind.streams == 1 else OF_TWO)


def at_random(count: int) -> list[int]:
    """A random order, always the same: Fisher and Yates by a Mersenne twister with the seed 0."""
    order = list(range(count))
    drawn = np.random.RandomState(0).randint(0, 2**32, count, np.uint32).tolist()
    for place in range(count - 1):
        other = place + drawn[place] % (count - place)
        order[place], order[other] = order[other], order[place]
    return order


def is_followed(gain: float, followed: float, alone: float) -> bool:
    """Whether a drive is followed, by its gain a query and by the mean confidence in its answers if
    it is followed and if each query is judged alone: a drive unless that makes its answers less
    sure, others only if it makes them surer."""
    return followed > alone + (-MARGIN if gain > DRIVE else MARGIN)


def best_of(values: Array, top: int) -> tuple[Floats, Array]:
    """The highest of values ``(R,)`` above -inf, the first of equals first, and their rows: -inf
    and -1 where there are fewer."""
    order = [row for row in np.argsort(-values, kind="stable") if values[row] > -np.inf][:top]
    scores, rows = np.full(top, -np.inf), np.full(top, -1)
    scores[: len(order)], rows[: len(order)] = values[order], order
    return scores, rows


def places(
    scores: Array, sequences: Sequence[str], motion: Motion, way: int, later: int, top: int
) -> Places:
    """The candidates of each query of a drive that is followed: rows without a score are none,
    unless the query is empty."""
    beliefs, unmapped = follow(scores, sequences, motion, way, later)
    count, names = len(scores), np.asarray(sequences)
    best, rows = np.zeros((count, top)), np.zeros((count, top), int)
    near, chances = np.zeros(count), np.zeros(count)
    for query, (row, belief) in enumerate(zip(scores, beliefs, strict=True)):
        known = row > -np.inf
        best[query], rows[query] = best_of(np.where(known | ~known.any(), belief, -np.inf), top)
        if (first := rows[query, 0]) >= 0:
            beside = np.abs(np.arange(len(names)) - first) <= NEAR
            near[query] = belief[beside & (names == names[first])].sum()
        values = np.where(known, np.log(np.maximum(belief, LEAST_BELIEF)), -np.inf)
        chances[query], _ = chance(values)
    return Places(best, rows, near, unmapped, chances)


LEAST_BELIEF = 1e-38


def decide(
    scores: Array,
    sequences: Sequence[str],
    mode: str | None,
    delay: int,
    top: int,
    matching: Sequence[int] | None = None,
) -> Decision:
    """The decision about the queries ``(Q, R)`` of one drive: each is judged alone, and the drive
    is followed online or offline if that is asked for, it has a course, and its answers are not
    less sure for it. An empty query has no candidate. ``matching`` is how many rows could match
    each query, by default those with a score."""
    shape = len(scores), top
    best = [best_of(row, top) for row in scores]
    values = np.reshape([each for each, _ in best], shape)
    rows = np.reshape([each for _, each in best], shape).astype(int)
    answered = rows[:, 0] >= 0
    taken, gained = course(scores, sequences) if mode else (Course(), 0.0)
    later = delay if mode == "online" else len(scores)
    counts: Sequence[int | None] = matching or [None] * len(scores)
    judged = [chance(nearness(row), None, each) for row, each in zip(scores, counts, strict=True)]
    rivals = np.array([rival for _, rival in judged])
    together = answers_together(rivals[answered])
    chances = np.where(answered, [each for each, _ in judged], np.nan)
    for stream in (slice(number, None, taken.streams) for number in range(taken.streams)):
        if gained:
            chances[stream][lingering(scores[stream], rows[stream, 0], later)] = 1
    right, spread = confidence(chances, mapped(chances, together), together)
    followed = False
    if gained:
        found, alone = follow_course(scores, sequences, taken, later, top)
        chances = np.where(answered, found.chance, np.nan)
        has = mapped(np.where(answered, alone, np.nan), together, BEST)
        surer = confidence(chances, has, together)[0].mean()
        followed = is_followed(gained, float(surer), float(right.mean()))
    if followed:
        values, rows = found.scores.copy(), found.rows.copy()
        values[:, 0] = np.where(rows[:, 0] >= 0, found.near, -np.inf)
        values[~answered], rows[~answered] = -np.inf, -1
        together = max(AROUND, together)
        right, spread = confidence(chances, has, together, followed)
    if len(sequences) < MIN_FRAMES:
        right = np.zeros(len(right))
    return Decision(
        *(values, rows, right, spread, np.full(len(scores), together), followed, *taken, gained)
    )


def follow_course(
    scores: Array, sequences: Sequence[str], taken: Course, later: int, top: int
) -> tuple[Places, Floats]:
    """The places of the queries of all streams of a course, given so many later queries of their
    stream, and the chance of each by its query alone. A track lasts where the map lacks the place,
    so the frames around an answer must show it too, and move on as they change: of all chances the
    highest counts."""
    motion, streams = Motion().at(taken.rate), []
    for stream in (scores[number :: taken.streams] for number in range(taken.streams)):
        found = places(stream, sequences, motion, taken.way, later, top)
        rows = found.rows[:, 0]
        around = chances_around(stream, sequences, rows, motion, min(later, AROUND))
        alone = chances_around(stream, sequences, rows, motion, 0, 0)
        lingers = lingering(stream, rows, later).astype(float)
        chances = np.max([found.chance, around, lingers], axis=0)
        streams.append((*found._replace(chance=chances), np.maximum(alone, lingers)))
    order = np.argsort(
        [query for n in range(taken.streams) for query in range(n, len(scores), taken.streams)]
    )
    *parts, alone = (np.concatenate(each)[order] for each in zip(*streams, strict=True))
    return Places(*parts), alone


def chances_around(
    scores: Array,
    sequences: Sequence[str],
    rows: Array,
    motion: Motion,
    later: int,
    earlier: int = AROUND,
) -> Floats:
    """How the answers of a stream, their rows ``(Q,)``, compare with their rivals by the frames
    around each: so many earlier ones and so many later, as far as no step is longer than the motion
    can make. The value of a row is the sum of the z-scores of these frames along the same path,
    moved to it; equal scores say nothing. The chance is 1 if a row elsewhere is better than all
    within `NEAR` of the answer."""
    z = [each * (deviation > MIN_SPREAD) for each, _, deviation in map(z_scores, scores)]
    longest = max(max(steps_of(speed, motion.rate)) for speed in range(len(SPEEDS)))
    names, here = np.asarray(sequences), np.arange(len(sequences))
    chances = np.ones(len(rows))
    for query in np.flatnonzero(rows >= 0):
        total = z[query].copy()
        for way, most in ((-1, earlier), (1, later)):
            before = rows[query]
            for other in range(query + way, query + way * (most + 1), way):
                if not 0 <= other < len(rows) or rows[other] < 0:
                    break
                if abs(rows[other] - before) > longest:
                    break
                before, there = rows[other], here + rows[other] - rows[query]
                inside = (there >= 0) & (there < len(names))
                inside[inside] = names[there[inside]] == names[inside]
                total[inside] += z[other][there[inside]]
        values = np.where(scores[query] > -np.inf, total, -np.inf)
        near = (np.abs(here - rows[query]) <= NEAR) & (names == names[rows[query]])
        if values[near].max() >= values.max():
            chances[query], _ = chance(values)
    return chances


def lingering(scores: Array, rows: Array, later: int) -> npt.NDArray[np.bool_]:
    """Which answers of a stream, their rows ``(Q,)``, linger at one place while the frames go on
    to others, as where the map ends or has a hole: to more than half of the neighbours, `AROUND`
    earlier queries and so many later ones, at most as many, the row moves less than half as far
    as is usual for frames so far `apart`, and at most `ELSEWHERE`. Where less than one row is
    usual, none can be seen to linger."""
    lags, pairs = queries_apart(profiles(scores)), []
    for lag, query in itertools.product(range(1, AROUND + 1), range(len(rows))):
        if query >= lag and rows[query] >= 0 and rows[query - lag] >= 0:
            moved = abs(rows[query] - rows[query - lag])
            pairs.append((query, query - lag, lags[query, lag], moved))
    pace = np.median([moved / apart for _, _, apart, moved in pairs if apart >= 1] or [0.0])
    still, neighbours = np.zeros(len(rows)), np.zeros(len(rows))
    for query, before, apart, moved in pairs:
        stands = apart >= 1 and pace * apart >= 1
        stands = stands and moved <= ELSEWHERE and moved < pace * apart / 2
        neighbours[query] += 1
        still[query] += stands
        if query - before <= later:
            neighbours[before] += 1
            still[before] += stands
    found: npt.NDArray[np.bool_] = (neighbours >= AROUND / 2) & (still > neighbours / 2)
    return found


def profiles(scores: Array) -> Floats:
    """How each query ``(Q, R)`` sees the map: ``(Q, M)`` z-scores of length 1 of at most
    `COMPARED` rows, every so many; zeros where they are equal."""
    some = scores[:, :: max(1, -(-scores.shape[1] // COMPARED))]
    z = [each * (deviation > MIN_SPREAD) for each, _, deviation in map(z_scores, some)]
    seen = np.reshape(z, some.shape)
    lengths = np.linalg.norm(seen, axis=1, keepdims=True)
    found: Floats = seen / np.where(lengths > 0, lengths, 1)
    return found


def queries_apart(seen: Floats) -> Floats:
    """``(Q, AROUND + 1)``, how far each query is from the ones 0, 1, 2 and so on before it, in
    queries, by how alike their profiles ``(Q, M)`` are: as many as frames are apart for which that
    is usual, the median, and at most as many as they are."""
    apart, usual = np.zeros((len(seen), AROUND + 1)), [1.0]
    for lag in range(1, min(AROUND, len(seen) - 1) + 1):
        likeness = (seen[lag:] * seen[:-lag]).sum(1)
        usual.append(min(usual[-1], float(np.median(likeness))))
        levels = np.array(usual)
        first = np.minimum(np.searchsorted(-levels, -(likeness + ALIKE)), lag)
        before = levels[np.maximum(first - 1, 0)]
        part = (before - likeness) / np.maximum(before - levels[first], ALIKE**2)
        apart[lag:, lag] = np.where(first > 0, first - 1 + np.clip(part, 0, 1), 0)
    return apart
