"""What the core computes of a live stream, as formulas: whole arrays, float64, one frame after
another. docs/loops.md has the same in words, and how the constants were chosen."""

import math

import numpy as np

ROUNDING, MIN_SPREAD, MAX_LOG = 1e-6, 1e-6, 50.0

# ------------------------------------------------------------------- scores of a frame by a channel

BEFORE = 10
"""Frames that the mean of all frames before a stretch counts in the mean of the stretch: what its
own first frames have in common is their place."""
MOVES = 2
"""Columns by which signs are moved to each side."""
ELSEWHERE = 5
"""Rows farther apart show different places."""


def means(frames, counted, starts):
    """``(N, ...)``, the mean of the stretch of each frame ``(N, ...)``; not all count in it."""
    result = np.zeros_like(frames)
    for first, last in zip(starts, [*starts[1:], len(frames)], strict=True):
        total, count = frames[first:last].sum(0), counted[first:last].sum()
        if counted[:first].any():
            total = total + BEFORE * frames[:first].sum(0) / counted[:first].sum()
            count = count + BEFORE
        result[first:last] = total / max(1, count)
    return result


def scores_of_vectors(earlier, anchors, starts):
    """``(N,)`` cosines of the best anchor ``(S, D)`` of a frame to earlier frames ``(N, D)``, each
    without the mean of its stretch; -inf for an empty frame."""
    frames = np.concatenate((earlier, anchors[len(anchors) // 2][None])).astype(np.float64)
    described = frames.any(axis=1)
    mean = means(frames, described, starts)
    rows, anchors = (frames - mean)[:-1], anchors - mean[-1]
    anchors[np.abs(anchors).max(axis=1) <= ROUNDING] = 0
    anchors /= np.maximum(np.linalg.norm(anchors, axis=1, keepdims=True), ROUNDING)
    lengths = np.maximum(np.linalg.norm(rows, axis=1), 1e-9**0.5)
    return np.where(described[:-1], (rows @ anchors.T).max(axis=1) / lengths, -np.inf)


def scores_of_signs(earlier, signs, starts):
    """``(N,)`` cosines of signs ``(columns, rows, bytes)``, as 1 and -1 without the mean of their
    stretch, to those of earlier frames: of the best move, over the columns that overlap."""
    bits = np.unpackbits(np.concatenate((earlier, signs[None])), axis=-1, bitorder="little")
    numbers = bits.reshape(*bits.shape[:2], -1).astype(np.float64) * 2 - 1
    numbers -= means(numbers, np.ones(len(numbers), bool), starts)
    columns, scores = numbers.shape[1], []
    for move in range(-min(MOVES, columns - 1), min(MOVES, columns - 1) + 1):
        here = numbers[-1, max(0, -move) : columns - max(0, move)].ravel()
        there = numbers[:-1, max(0, move) : columns - max(0, -move)].reshape(len(earlier), -1)
        lengths = np.linalg.norm(there, axis=1) * np.linalg.norm(here)
        scores.append(there @ here / np.maximum(lengths, 1e-3))
    return np.minimum(np.max(scores, axis=0), 1)


def nearness(scores):
    """Minus the logarithm of 1 - cosine; -inf for -inf."""
    return -np.log(np.maximum(1 - scores, ROUNDING))


def z_scores(scores, rows):
    """Of the nearness of scores: deviations above the mean of the first rows, 0 where there is
    none; the mean and the deviation of these."""
    near = nearness(scores)
    known = near[:rows][np.isfinite(near[:rows])]
    mean, deviation = (known.mean(), known.std()) if len(known) else (0.0, 0.0)
    z = np.where(np.isfinite(near), (near - mean) / max(deviation, MIN_SPREAD), 0)
    return z, mean, deviation


def lead(scores):
    """How many deviations the nearest row is ahead of the nearest elsewhere."""
    if len(scores) <= 2 * ELSEWHERE + 1:
        return 0.0
    z, _, _ = z_scores(scores, len(scores))
    return z.max() - z[np.abs(np.arange(len(z)) - z.argmax()) > ELSEWHERE].max()


def fused(channels, weights, rows):
    """``(N,)`` scores by all channels as one: the weighted z-score, with the weighted mean and
    deviation; -inf where no channel has a score."""
    parts = [z_scores(scores, rows) for scores in channels.values()]
    weighted = zip(weights.values(), parts, strict=True)
    z, mean, deviation = sum(
        weight * np.array([z, np.full_like(z, mean), np.full_like(z, deviation)])
        for weight, (z, mean, deviation) in weighted
    )
    known = np.isfinite([*channels.values()]).any(axis=0)
    return np.where(known, 1 - np.exp(-(mean + deviation * z)), -np.inf)


# ----------------------------------------------------------------- stretches: where a stream breaks

GAP_SECONDS, GAP_STEPS = 600.0, 10.0
"""A gap is longer than this, and than so many usual steps."""
LAST_FRAMES, MIN_FRAMES = 50, 20
"""Frames before a gap that show what is usual: at most and at least."""
LAST, FAR_FRAMES = 3, 10
"""The last frames may show the present place; frames farther apart show others."""
MIN_LIKENESS, MIN_DEVIATIONS = 0.5, 3
"""Below it, the view after a gap is another one: likeness is 0 between different places, 1 from a
frame to the next, whose nearness is at least so many deviations above that of places."""


def is_gap(stamps, stamp):
    """Whether a stream whose last frames have these stamps pauses before the next."""
    known = [seconds for seconds in stamps if not math.isnan(seconds)]
    if len(known) < MIN_FRAMES or not stamp - known[-1] > GAP_SECONDS:
        return False
    return bool(stamp - known[-1] > GAP_STEPS * np.median(np.diff(known)))


def likeness(frames):
    """How alike the last of some frames ``(N, *shape)`` of a channel is to those before it."""
    flat = frames.reshape(len(frames), -1)
    if frames.dtype == np.uint8:
        flat = np.unpackbits(flat, axis=1).astype(np.float64) * 2 - 1
    vectors = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), ROUNDING)
    near = nearness(vectors.astype(np.float64) @ vectors.T)
    before = near[:-1, :-1]
    elsewhere = before[np.tril_indices(len(before), -FAR_FRAMES)]
    usual = np.median(np.diag(before, -1)) - np.median(elsewhere)
    step = near[-1, -1 - LAST : -1].max() - np.median(elsewhere)
    return step / max(usual, MIN_DEVIATIONS * elsewhere.std(), ROUNDING)


# ------------------------------------------------- repeats: how much a street is alike all along it

MARGIN, DISTANT, TRACK = 1.2, 5, 15
"""A frame is seen again where it is so much nearer than different places of its street are: these
are excluded frames a fifth of them apart or more, over so many frames in a row."""


class Repeats:
    """A street that repeats runs forwards, so the filter's rows run backwards do not tell it from a
    loop. But excluded frames are no loops: what they share with the present one is the street.
    ``highest`` ``(N,)`` is how self-similar it is around each frame of a stretch."""

    def __init__(self, exclude):
        self.nearest, self.farthest = max(1, exclude // DISTANT), exclude
        self.last, self.highest = [], np.zeros(0)

    def after(self, near):
        """Takes the nearness ``(N,)`` of the next frame to all earlier ones of the stretch."""
        more = len(near) + 1 - len(self.highest)
        self.highest = np.append(self.highest, np.full(more, -np.inf))
        rows = len(near) - np.arange(self.nearest, min(self.farthest, len(near)) + 1)
        distances = max(0, min(self.farthest + 1 - self.nearest, len(rows) + 1))
        seen = np.full(distances + 2, -np.inf)
        seen[1 : len(rows) + 1] = near[rows]
        # at the same distance, or one frame nearer or farther
        widest = np.maximum(np.maximum(seen[:-2], seen[1:-1]), seen[2:])
        self.last = [*self.last, widest][-TRACK:]
        shared = min(len(rows), *map(len, self.last))
        if len(self.last) < TRACK or not shared:
            return
        track = np.mean([widest[:shared] for widest in self.last], axis=0)
        self.highest[-TRACK:] = np.maximum(self.highest[-TRACK:], track.max())
        for age in range(TRACK):
            here = rows[:shared][rows[:shared] >= age] - age
            self.highest[here] = np.maximum(self.highest[here], track[: len(here)])


# --------------------------------------------------------------- tracks: returns in another light

TRACK_DECAY, MIN_STEP = 0.93, 0.02
EXPLAINED, BY_CHANCE = 0.9, 1.5
"""Quantile of the tracks by chance that a new place explains, by label maps alone; and how many
times as close as the closest of them a return is."""
CLEAR, SAME = 0.12, 0.75
"""Closeness is 0 for different places and 1 for a frame and the next: above the first tracks by
chance are too close to tell returns, above the second it is one light."""
USUAL, EARLIER = 100, 1000
MIN_BY_CHANCE, WAIT = 5, 25
"""Frames by chance that must be known; and how long no loop is closed before and after them."""


class Tracks:
    """In another light a frame is much less like the old one of its place than like the frame
    before, but the two drives run on side by side. How closely drives do so by chance, the stream
    itself shows: most of its frames are at new places."""

    def __init__(self, exclude, alone=False):
        self.exclude, self.alone, self.closeness = exclude, alone, np.zeros(0)
        self.steps, self.elsewhere, self.waiting, self.by_chance = [], [], [], []
        self.since, self.held, self.closest, self.densest = WAIT, 0, 0.0, 0.0

    @property
    def returning(self):
        """Whether the last frames run beside old ones in another light."""
        if self.alone or len(self.by_chance) < MIN_BY_CHANCE:
            return False
        highest = max(self.by_chance)
        clear = highest <= CLEAR and BY_CHANCE * highest <= self.closest
        return clear and self.densest <= self.closest < SAME

    @property
    def explained(self):
        """How much nearer than the mean an old frame can be to one of a new place."""
        if not self.alone or len(self.by_chance) < MIN_BY_CHANCE:
            return 0.0
        return np.quantile(self.by_chance, EXPLAINED) * self.step

    @property
    def step(self):
        """How much nearer than different places a frame is to the next."""
        return max(MIN_STEP, np.median(self.steps) - np.median(self.elsewhere))

    def after(self, near, old):
        """Takes the nearness ``(N,)`` of the next frame to all of the stretch, the first old."""
        before, self.closeness = self.closeness, np.zeros(len(near))
        if len(near) < 20 or near[-1] == -np.inf:
            return
        self.steps = [*self.steps, near[-1]][-USUAL:]
        self.elsewhere = [*self.elsewhere, np.median(near[-50:-10])][-USUAL:]
        known = near[:old][near[:old] > -np.inf]
        if not len(known):
            return
        close = np.where(np.isfinite(near), (near - known.mean()) / self.step, 0)
        self.closeness[len(near) - len(before) :] = TRACK_DECAY * before
        self.closeness += (1 - TRACK_DECAY) * close
        self.closest = self.closeness[:old].max()
        self.densest = self.closeness[old : len(near) - self.exclude // 2].max(initial=0)

    def decided(self, accepted):
        """Takes whether the frame closes a loop: what is by chance is then by chance no more."""
        self.held = self.held + 1 if self.returning and not accepted else 0
        if 0 < self.held <= 2 * WAIT:
            return
        reset = accepted or self.densest >= SAME  # a camera that stands
        self.since = 0 if reset else self.since + 1
        if reset:
            self.waiting = []
        elif self.since > WAIT and self.closest:
            self.waiting.append(self.closest)
            if len(self.waiting) > WAIT:
                self.by_chance = [*self.by_chance, self.waiting.pop(0)][-EARLIER:]


# ------------------------------------------------------ the filter: a hidden Markov model of rows

SPEEDS = (
    (0.08, {-1: 0.05, 0: 0.9, 1: 0.05}),
    (0.16, {0: 0.5, 1: 0.5}),
    (0.34, {0: 0.1, 1: 0.8, 2: 0.1}),
    (0.16, {1: 0.5, 2: 0.5}),
    (0.14, {1: 0.1, 2: 0.8, 3: 0.1}),
    (0.07, {2: 0.1, 3: 0.8, 4: 0.1}),
    (0.05, {3: 0.15, 4: 0.7, 5: 0.15}),
)
"""Probability of each speed, and of its steps in rows."""
CHANGE, JUMP, UNMAPPED, STAY = 0.01, 0.01, 0.3, 0.97
"""Probabilities: the speed changes; a jump; it leads to a new place; to stay at new places."""


class Filter:
    """States are speeds and rows, run forwards and, as a decoy, backwards; and a new place.
    ``mapped`` is ``(2, 7, N)``."""

    def __init__(self):
        self.stretches, self.mapped = np.zeros(0, int), np.zeros((2, len(SPEEDS), 0))
        self.restart()

    def extend(self, stretches):
        """Adds rows by the numbers of their stretches; nothing is believed of them."""
        self.stretches = np.append(self.stretches, np.array(stretches, int))
        self.mapped = np.pad(self.mapped, ((0, 0), (0, 0), (0, len(stretches))))

    def restart(self):
        """Forgets the place: the next frame starts a stretch."""
        self.unmapped = UNMAPPED if len(self.stretches) else 1.0
        self.mapped, self.starting = self.anywhere(1 - self.unmapped), True

    def anywhere(self, probability):
        prior = np.array([chance for chance, _ in SPEEDS])[:, None]
        share = probability / (2 * max(1, len(self.stretches)))
        return np.broadcast_to(prior * share, self.mapped.shape[:2] + self.stretches.shape).copy()

    def step(self, likelihood):
        """``(N,)`` the probability of each row after a frame, by how much likelier it is there than
        at a new place."""
        if not self.starting:
            moved, rows = self.transition(), len(self.stretches)
            lost = max(0.0, 1 - self.unmapped - moved.sum())
            arriving = lost * (1 - UNMAPPED) + self.unmapped * (1 - STAY)
            self.unmapped = lost * UNMAPPED + self.unmapped * STAY if rows else 1.0
            self.mapped = moved + self.anywhere(arriving)
        self.starting = False
        self.mapped = self.mapped * likelihood
        total = self.mapped.sum() + self.unmapped
        self.mapped, self.unmapped = self.mapped / total, self.unmapped / total
        return self.mapped[0].sum(axis=0)

    def transition(self):
        """The belief one frame later, without jumps; what leaves its stretch is lost."""
        later, rows = np.zeros_like(self.mapped), np.arange(len(self.stretches))
        for way, belief in enumerate(self.mapped):
            for speed, (prior, steps) in enumerate(SPEEDS):
                turned = (1 - CHANGE) * belief[speed] + CHANGE * prior * belief.sum(axis=0)
                for step, chance in steps.items():
                    to = rows + (1, -1)[way] * step
                    inside = (to >= 0) & (to < len(rows))
                    inside[inside] = self.stretches[to[inside]] == self.stretches[inside]
                    later[way, speed, to[inside]] += (1 - JUMP) * chance * turned[inside]
        return later


# ------------------------------------------------------------------------------------- the stream

WEIGHT, LEVEL = 0.25, 0.5
"""Of another stretch, a row with the z-score z is exp(WEIGHT * (z - level)) times as likely as a
new place; the level is at least LEVEL, and what tracks explain by chance."""
FITS, MIN_FITS, FIT, FIT_WEIGHT = 20, 5, 0.5, 2
"""Once so many of the last loops of a stretch show how well the right rows fit, a row that fits
half as well is as likely as a new place, and a z-score counts twice. By one channel, never."""
EVIDENCE, LEVEL_FRACTION = 3.0, 0.9
"""Of the same stretch, which shares light and network, a row at twice the level is exp(EVIDENCE)
times as likely: the level is a fraction of the z-score that three quarters of frames have to the
one before, and at least the highest by chance."""
NEIGHBOURS, STRIDE, RECENT = 1000, 50, 10
RADIUS_ROWS, MAX_PLACES, MIN_PROBABILITY = 5, 5, 0.01


class Loops:
    """A live stream, as `native.loops.Loops` but for large ones; a step is a tuple of the reason,
    the candidate, its score and its probability, and the places."""

    def __init__(self, channels, exclude=50, threshold=0.8):
        self.channels, self.exclude, self.threshold = channels, exclude, threshold
        self.frames = {channel.name: [] for channel in channels}
        self.leads = {channel.name: 0.0 for channel in channels}
        self.stamps, self.starts, self.explained = [], [], []
        self.tracks, self.filter = Tracks(exclude, len(channels) == 1), Filter()

    @property
    def weights(self):
        """Of each channel: its trust, times the sum of its leads so far if any leads."""
        trust = {channel.name: channel.trust for channel in self.channels}
        known = {name: trust[name] * self.leads[name] for name in trust}
        chosen = known if any(known.values()) else trust
        return {name: weight / sum(chosen.values()) for name, weight in chosen.items()}

    def update(self, descriptors, stamp=math.nan, starts=False):
        """Looks for the place of the next frame among the earlier ones, then stores it."""
        anchors = {
            channel.name: np.asarray(descriptors[channel.name]).reshape(-1, *channel.shape)
            for channel in self.channels
        }
        centres = {name: array[len(array) // 2] for name, array in anchors.items()}
        self.arrive(centres, stamp, starts)
        step = self.step(anchors, centres)
        self.store(centres, stamp)
        return step

    def extend(self, descriptors, stamps, starts):
        """Stores frames as if they had come, without results."""
        for row, first in enumerate(starts):
            centres = {name: array[row] for name, array in descriptors.items()}
            self.arrive(centres, stamps[row], first)
            self.store(centres, stamps[row])

    def arrive(self, centres, stamp, starts):
        """What comes before a frame: a new stretch, and another state of the filter."""
        if not self.starts or starts or self.breaks(centres, stamp):
            if self.starts:
                self.explained.append(self.tracks.explained)
                self.tracks = Tracks(self.exclude, len(self.channels) == 1)
            self.starts.append(len(self.stamps))
            self.neighbours, self.fits, self.repeats = [], [], Repeats(self.exclude)
            self.filter.restart()
        last, rows = len(self.stamps) - min(RECENT, self.exclude), len(self.filter.stretches)
        fresh = np.arange(rows, max(last, rows))
        self.filter.extend(np.searchsorted(self.starts, fresh, side="right").tolist())

    def breaks(self, centres, stamp):
        first = max(self.starts[-1], len(self.stamps) - LAST_FRAMES)
        if not is_gap(self.stamps[first:], stamp):
            return False
        alike = [likeness(np.array([*self.frames[n][first:], centres[n]])) for n in centres]
        return np.mean(alike) < MIN_LIKENESS

    def store(self, centres, stamp):
        for name, frames in self.frames.items():
            frames.append(centres[name])
        self.stamps.append(stamp)

    def step(self, anchors, centres):
        first, old = self.channels[0].name, max(0, len(self.stamps) - self.exclude)
        described = np.array([frame.any() for frame in self.frames[first]], bool)
        too_few = np.count_nonzero(described[:old]) < 2
        if not centres[first].any():
            if not too_few:
                self.filter.step(np.ones(len(self.filter.stretches)))
            return "empty_frame", None, None, None, ()
        if not described.any():
            return "no_candidate", None, None, None, ()
        scores = self.scores(anchors, 0 if too_few else old)
        scores[~described] = -np.inf
        near = nearness(scores)
        self.repeats.after(near[self.starts[-1] :])
        if too_few:
            return "too_recent", None, None, None, ()
        known = near[:old][np.isfinite(near[:old])]
        mean, deviation = known.mean(), known.std()
        tells = deviation > MIN_SPREAD and np.ptp(known) > MIN_SPREAD
        emission = self.emission(near, mean, deviation, old) if tells else np.ones(len(near))
        step = self.result(self.filter.step(emission[: len(self.filter.stretches)]), scores, old)
        if step[0] == "accepted" and tells:
            self.fits = [*self.fits, (near[step[1]] - mean) / deviation][-FITS:]
        return step

    def scores(self, anchors, old):
        """``(N,)`` scores of a frame by all channels, scaled by those of the old frames, if any."""
        scores = {}
        for name, _, dtype, _ in self.channels:
            earlier = np.array(self.frames[name])
            if dtype == "uint8":
                scores[name] = scores_of_signs(earlier, anchors[name][0], self.starts)
            else:
                scores[name] = scores_of_vectors(earlier, anchors[name], self.starts)
            self.leads[name] += max(0.0, lead(scores[name][:old]))
        if len(scores) == 1:
            return next(iter(scores.values()))
        return fused(scores, self.weights, old or len(self.stamps))

    def emission(self, near, mean, deviation, old):
        """``(N,)``, how much likelier a frame is at each row than at a new place."""
        start, z = self.starts[-1], (near - mean) / deviation
        same, candidates = z[start:], max(0, len(z) - self.starts[-1] - self.exclude)
        previous = len(same) - max(1, self.exclude // STRIDE)
        if previous >= 0 and np.isfinite(same[previous]):
            self.neighbours = [*self.neighbours, same[previous]][-NEIGHBOURS:]
        usual = np.quantile(self.neighbours, 0.25) if self.neighbours else 0.0
        by_chance = math.sqrt(2 * math.log(max(2, len(z))))
        level = max(LEVEL, LEVEL_FRACTION * usual, by_chance)
        self.tracks.after(near[start:], candidates)
        explained = np.repeat(np.array(self.explained), np.diff(self.starts)) / deviation
        weight, fit = self.fit()
        earlier = exp(weight * (z[:start] - np.maximum(fit, explained)))
        likely = exp(EVIDENCE / level * (same - level))
        repeats = (self.repeats.highest[: len(same)] - mean) * MARGIN / deviation - level
        likely[:candidates] *= np.exp(-EVIDENCE / level * np.maximum(0, repeats))[:candidates]
        if self.tracks.returning:
            likely[:candidates] = np.maximum(likely, exp(weight * (same - fit)))[:candidates]
        return np.concatenate((earlier, likely))

    def fit(self):
        """The weight and the level of rows of another stretch."""
        known = len(self.channels) > 1 and len(self.fits) >= MIN_FITS
        level = FIT * np.median(self.fits) if known else 0.0
        return (FIT_WEIGHT * WEIGHT, level) if level > LEVEL else (WEIGHT, LEVEL)

    def result(self, rows, scores, old):
        """The step, by the probabilities of the rows."""
        candidate = int(np.where(np.isfinite(scores[:old]), rows[:old], -1).argmax())
        at_old, recent, places = rows[:old].sum(), rows[old:].sum(), []
        left, row = rows[:old].copy(), candidate
        for _ in range(MAX_PLACES):
            near = slice(max(0, row - RADIUS_ROWS), row + RADIUS_ROWS + 1)
            places.append((row, min(1.0, left[near].sum())))
            left[near] = 0
            row = int(left.argmax())
        probability, reason = places[0][1], "below_threshold"
        if probability >= self.threshold:
            reason = "accepted"
        elif recent > max(at_old, 1 - at_old - recent):
            reason = "too_recent"
        elif at_old >= self.threshold:
            reason = "ambiguous"
        self.tracks.decided(reason == "accepted")
        likely = [place for place in places if place[1] >= MIN_PROBABILITY]
        return reason, candidate, scores[candidate], probability, tuple(likely)


def exp(logarithm):
    return np.exp(np.minimum(logarithm, MAX_LOG))
