"""Reference: from descriptors to decisions plainly, in NumPy. The oracle of this room.

One channel after another is compared with the map, the scores are fused, the drive is followed by
a hidden Markov model, and each answer is held beside its rivals. Every step is written as its
formula says, with whole matrices and float64; all other forms are held to it by the tests.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .confidence import prior
from .motion import ELSEWHERE, MAX_LOG, MIN_SPREAD, ROUNDING, SPEEDS, Motion, steps_of
from .rivals import PLACES, ROWS_A_PLACE
from .standardise import MIN_FRAMES

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

REACH = 2
"""Columns by which signs are moved to each side."""
SAMPLE = 200
"""Queries that show what leads; if there are more, every so many."""
EQUAL = 1e-6
"""A vector this near to the mean equals it: its drive has one frame, or all frames are equal."""

_LEAST_LENGTH = 1e-3


def means_of_drives(numbers: Array, sequences: Sequence[str]) -> Floats:
    """``(N, ...)``, what is subtracted from each frame: the mean of its drive. Adjacent drives of
    fewer than `MIN_FRAMES` frames share a mean, and if they have too few together, they have that
    of all; fewer than `MIN_FRAMES` frames in all have none. Frames of zeros do not count."""
    means = np.zeros(numbers.shape)
    if len(numbers) < MIN_FRAMES:
        return means
    drives = [list(run) for _, run in itertools.groupby(range(len(numbers)), sequences.__getitem__)]
    for short, run in itertools.groupby(drives, lambda drive: len(drive) < MIN_FRAMES):
        adjacent = list(run)
        for rows in [list(itertools.chain(*adjacent))] if short else adjacent:
            of = numbers[rows] if len(rows) >= MIN_FRAMES else numbers
            known = of[of.reshape(len(of), -1).any(1)]
            means[rows] = known.mean(0) if len(known) else 0
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


def without_means(vectors: Array, sequences: Sequence[str]) -> Floats:
    """Vectors ``(N, D)`` less the means of their drives; zeros stay, and what equals its mean
    stays as it is."""
    means = means_of_drives(vectors, sequences)
    less = vectors.any(1) & (np.abs(vectors - means) > EQUAL).any(1)
    found: Floats = np.where(less[:, None], vectors - means, vectors)
    return found


def compare_vectors(
    queries: Array, references: Array, sequences: Sequence[str], standardised: bool, sweep: bool
) -> tuple[Floats, int]:
    """``(Q, R)`` scores of the queries of one drive from S anchors ``(Q, S, D)``, by the best of
    them or by the middle one, against ``(R, D)``; and how many anchors to each side count."""
    middle = queries.shape[1] // 2
    enough = standardised and len(queries) >= MIN_FRAMES
    rows = without_means(references, sequences) if standardised else references
    widths, scores = range(middle + 1 if sweep else 1), list[Floats]()
    for width in widths:
        part = queries[:, middle - width : middle + width + 1]
        if enough:
            every = part.reshape(-1, part.shape[2])
            part = without_means(every, [""] * len(every)).reshape(part.shape)
        scores.append(np.max([cosines(each, rows) for each in part.swapaxes(0, 1)], axis=0))
    leads = [mean_lead(each) for each in scores]
    best = int(np.argmax(leads))
    return scores[best], widths[best]


def mean_lead(scores: Array) -> float:
    """How much nearer the nearest row is than the nearest elsewhere, on average over a sample of
    the queries that have both."""
    rows = np.arange(scores.shape[1])
    if len(rows) <= 2 * ELSEWHERE + 1:
        return 0.0
    leads = []
    for each in scores[:: max(1, len(scores) // SAMPLE)]:
        elsewhere = np.abs(rows - each.argmax()) > ELSEWHERE
        near = nearness(np.array([each.max(), each[elsewhere].max()]))
        leads.append(near[0] - near[1] if np.isfinite(near).all() else np.nan)
    return float(np.nanmean(leads)) if np.isfinite(leads).any() else 0.0


def compare_signs(
    queries: Array, references: Array, sequences: Sequence[str], standardised: bool, sweep: bool
) -> Floats:
    """``(Q, R)`` scores of the queries of one drive, signs ``(Q, columns, ...)`` uint8, against
    those of a map, by the best move or by none."""
    sides = []
    for signs, names in (queries, [""] * len(queries)), (references, sequences):
        bits = np.unpackbits(signs.reshape(*signs.shape[:2], -1), axis=2, bitorder="little")
        side = 2.0 * bits - 1
        sides.append(side - means_of_drives(side, names) if standardised else side)
    return cosines_of_signs(*sides, REACH if sweep else 0)


def nearness(scores: Array) -> Floats:
    """Minus the logarithm of 1 - cosine; -inf for -inf."""
    return -np.log(np.maximum(1 - scores.astype(np.float64), ROUNDING))


def z_scores(scores: Array) -> tuple[Floats, float, float]:
    """Of the nearness of scores ``(R,)``: how many deviations each is above the mean, 0 where there
    is none; the mean and the deviation."""
    known = np.isfinite(scores)
    near = np.where(known, nearness(np.where(known, scores, 0)), 0)
    mean = near.sum() / max(1, known.sum())
    centred = np.where(known, near - mean, 0)
    deviation = math.sqrt(np.square(centred).sum() / max(1, known.sum()))
    return centred / max(deviation, MIN_SPREAD), float(mean), deviation


def lead(scores: Array) -> float:
    """How many deviations the nearest row is ahead of the nearest elsewhere."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    z, _, _ = z_scores(scores)
    elsewhere = np.abs(np.arange(len(z)) - z.argmax()) > ELSEWHERE
    return float(z.max() - z[elsewhere].max())


def weights_of(channels: Mapping[str, Array], trust: Mapping[str, float]) -> dict[str, float]:
    """The weight of each channel by its scores ``(Q, R)`` of a drive: its trust, times the mean
    lead of its first candidates if there are `MIN_FRAMES` queries and one leads."""
    known = {name: trust.get(name, 1.0) for name in channels}
    leads = {
        name: max(0.0, float(np.mean([lead(row) for row in scores])))
        for name, scores in channels.items()
        if len(scores) >= MIN_FRAMES
    }
    if any(leads.values()):
        known = {name: known[name] * leads[name] for name in known}
    return {name: weight / sum(known.values()) for name, weight in known.items()}


def fused(channels: Mapping[str, Array], weights: Mapping[str, float]) -> Floats:
    """``(Q, R)`` scores of all channels as one: the weighted z-score, with the weighted mean and
    deviation, as a cosine."""
    queries, rows = next(iter(channels.values())).shape
    scores = np.full((queries, rows), -np.inf)
    for query in range(queries):
        z, mean, deviation = np.zeros(rows), 0.0, 0.0
        for name, of_channel in channels.items():
            own_z, own_mean, own_deviation = z_scores(of_channel[query])
            z += weights[name] * own_z
            mean += weights[name] * own_mean
            deviation += weights[name] * own_deviation
        some = np.any([np.isfinite(each[query]) for each in channels.values()], axis=0)
        scores[query, some] = 1 - np.exp(-(mean + deviation * z[some]))
    return scores


def likelihood(scores: Array, motion: Motion) -> Floats:
    """How much likelier a query is at each row than at a place that the map lacks, ``(R,)``."""
    z, _, deviation = z_scores(scores)
    if deviation <= MIN_SPREAD:
        return np.ones(len(scores))
    told = np.exp(np.minimum(motion.weight * (z - motion.level), MAX_LOG))
    return np.where(np.isfinite(scores), told, 0)


def transitions(sequences: Sequence[str], motion: Motion, way: int) -> tuple[Floats, Floats]:
    """The probabilities of all states after each state, and those at the start. A state is a speed
    and a row, in this order; the last one is a place that the map lacks."""
    rows, size = len(sequences), len(SPEEDS) * len(sequences) + 1
    enter = np.append(np.repeat([chance for chance, _ in SPEEDS], rows) / rows, 0.0)
    matrix = np.zeros((size, size))
    for before, row in itertools.product(range(len(SPEEDS)), range(rows)):
        here = before * rows + row
        for after, (chance, _) in enumerate(SPEEDS):
            turned = motion.change * chance + (1 - motion.change) * (after == before)
            for step, part in steps_of(after, motion.rate).items():
                there = row + way * step
                if 0 <= there < rows and sequences[there] == sequences[row]:
                    matrix[here, after * rows + there] += (1 - motion.jump) * turned * part
        lost = 1 - matrix[here].sum()
        matrix[here] += lost * (1 - motion.unmapped) * enter
        matrix[here, -1] += lost * motion.unmapped
    matrix[-1] = (1 - motion.stay) * enter
    matrix[-1, -1] += motion.stay
    start = enter * (1 - motion.unmapped)
    start[-1] = motion.unmapped
    return matrix, start


def follow(
    scores: Array, sequences: Sequence[str], motion: Motion, way: int, later: int
) -> tuple[Floats, Floats]:
    """Of each query ``(Q, R)`` probabilities of the rows, and ``(Q,)`` of a place that the map
    lacks, given all earlier queries and so many later ones: forward-backward."""
    matrix, start = transitions(sequences, motion, way)
    told = [
        np.append(np.tile(likelihood(row, motion), len(SPEEDS)), 1.0) for row in np.asarray(scores)
    ]
    forward = [start * told[0]]
    for each in told[1:]:
        forward.append((forward[-1] / forward[-1].sum()) @ matrix * each)
    places = []
    for query, belief in enumerate(forward):
        back = np.ones(len(start))
        for each in reversed(told[query + 1 : query + 1 + later]):
            back = matrix @ (each * back)
            back /= back.max()
        places.append(belief * back / (belief * back).sum())
    found = np.stack(places)
    return found[:, :-1].reshape(len(found), len(SPEEDS), -1).sum(1), found[:, -1]


def gain(scores: Array, sequences: Sequence[str], motion: Motion, way: int) -> float:
    """How much likelier the queries are as a drive than each alone, as a logarithm."""
    matrix, start = transitions(sequences, motion, way)
    belief, total = start, 0.0
    for number, row in enumerate(np.asarray(scores)):
        told = np.append(np.tile(likelihood(row, motion), len(SPEEDS)), 1.0)
        belief = (belief @ matrix if number else start) * told
        total += math.log(belief.sum() / (start * told).sum())
        belief = belief / belief.sum()
    return total


def chance_of(values: Array) -> tuple[float, int]:
    """The probability that a wrong answer is as far ahead of its rivals as the best of values
    ``(R,)`` is, -inf where there is none; and the row of the best rival, -1 without one. See
    `rivals`."""
    near, rows = values.astype(np.float64), range(len(values))
    peaks = [
        row
        for row in rows
        if near[row] > -np.inf
        and not any(near[r] > near[row] for r in (row - 1, row + 1) if r in rows)
    ]
    best: list[int] = []
    for row in sorted(peaks, key=lambda row: -near[row]):
        if len(best) < PLACES and all(abs(row - other) > ELSEWHERE for other in best):
            best.append(row)
    rival = best[1] if len(best) > 1 else -1
    places = np.isfinite(near).sum() / ROWS_A_PLACE
    steps = -np.diff(near[best])[: max(0, int(places) - 1)]
    if len(steps) < 2:
        return 1.0, rival
    ahead, *below = steps / mean_steps(places)[: len(steps)]
    return float((1 + ahead / max(sum(below), 1e-9)) ** -len(below)), rival


def mean_steps(places: float) -> Floats:
    """The mean steps between the highest of so many normal values (Blom, 1958)."""
    from statistics import NormalDist

    ranks = np.arange(1, min(PLACES, int(places)) + 1)
    means = [NormalDist().inv_cdf(1 - (rank - 0.375) / (places + 0.25)) for rank in ranks]
    return -np.diff(means)


def doubts(chances: Array, together: float) -> Floats:
    """The probability that each answer of a traverse is wrong, by its chance ``(Q,)``: the mean
    over the prior, weighed by how likely each of its points makes all chances; queries that err
    together count as one. See `confidence`."""
    wrong, rate, shape, log_weight = (np.asarray(each) for each in prior())
    ahead = -np.log(np.clip(chances, math.exp(-20), 1 - 1e-3))
    likelier = np.stack(
        [
            np.exp(k * math.log(r) - math.lgamma(k) + (k - 1) * np.log(ahead) + (1 - r) * ahead)
            for r, k in zip(rate, shape, strict=True)
        ]
    )
    told = wrong[:, None] + (1 - wrong[:, None]) * likelier
    log = log_weight + np.log(told).sum(1) / together
    weights = np.exp(log - log.max())
    doubt: Floats = (weights / weights.sum()) @ (wrong[:, None] / told)
    return doubt
