"""What the core computes of a live stream, as formulas: whole arrays, float64, one frame after
another. docs/concepts/equations.md has the same in words."""

import math

import numpy as np
from oracles.filter import BACKWARDS, FORWARDS, MAX_LOG, MIN_SPREAD, NUMBERS, SPEEDS, Model, Motion
from oracles.recognition import ROUNDING, cosines_of_signs, fused, lead, nearness

from ssrvlad_torch.native.headers import model

# ------------------------------------------------------------------- scores of a frame by a channel

LOOPS = model("Loop")
BEFORE = int(NUMBERS["before"])
ACROSS, ALONG = 3, 2
"""Columns and rows by which signs are moved to each side."""


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
    stretch, to those of earlier frames."""
    bits = np.unpackbits(np.concatenate((earlier, signs[None])), axis=-1, bitorder="little")
    numbers = bits.astype(np.float64) * 2 - 1
    numbers -= means(numbers, np.ones(len(numbers), bool), starts)
    across, along = min(ACROSS, len(signs) - 1), min(ALONG, len(signs[0]) - 1)
    return cosines_of_signs(numbers[-1:], numbers[:-1], across, along)[0]


# ------------------------------------------------- repeats: how much a street is alike all along it

DISTANT, TRACK = int(LOOPS["distant"]), int(LOOPS["track"])


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

CLEAR, SAME, WAIT = LOOPS["clear"], LOOPS["same"], int(LOOPS["wait"])
USUAL, MEMORY = int(LOOPS["usual"]), int(LOOPS["memory"])
BESIDE = int(NUMBERS["elsewhere"])


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
        if self.alone or len(self.by_chance) < LEAST_KNOWN:
            return False
        highest = max(self.by_chance)
        clear = highest <= CLEAR and LOOPS["by_chance"] * highest <= self.closest
        return clear and self.densest <= self.closest < SAME

    @property
    def explained(self):
        """How much nearer than the mean an old frame can be to one of a new place."""
        if not self.alone or len(self.by_chance) < LEAST_KNOWN:
            return 0.0
        return np.quantile(self.by_chance, LOOPS["explained"]) * self.step

    @property
    def step(self):
        """How much nearer than different places a frame is to the next."""
        return max(NUMBERS["rounding"], np.median(self.steps) - np.median(self.elsewhere))

    def after(self, near, old):
        """Takes the nearness ``(N,)`` of the next frame to all of the stretch, the first old."""
        before, self.closeness = self.closeness, np.zeros(len(near))
        if len(near) < 2 * BESIDE or near[-1] == -np.inf:
            return
        self.steps = [*self.steps, near[-1]][-USUAL:]
        self.elsewhere = [*self.elsewhere, np.median(near[-USUAL:-BESIDE])][-USUAL:]
        seen = near[:old][near[:old] > -np.inf]
        if not len(seen):
            return
        close = np.where(np.isfinite(near), (near - seen.mean()) / self.step, 0)
        self.closeness[len(near) - len(before) :] = LOOPS["smoothing"] * before
        self.closeness += (1 - LOOPS["smoothing"]) * close
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
                self.by_chance = [*self.by_chance, self.waiting.pop(0)][-MEMORY:]


# ------------------------------------------------------------------------------------- the stream

MOTION = Motion(**{name: LOOPS[name] for name in ("change", "unmapped", "stay", "weight")})
FITS, LEAST_KNOWN = int(LOOPS["fits"]), int(LOOPS["least_known"])
STRIDE = int(LOOPS["stride"])
RADIUS_ROWS, MAX_PLACES = 5, 5


class Loops:
    """A live stream without gaps, as `native.loops.Loops` but for large ones; a step is a tuple of
    the reason, the candidate, its score and its probability, and the places."""

    def __init__(self, channels, exclude=50, threshold=0.8):
        self.channels, self.exclude, self.threshold = channels, exclude, threshold
        self.frames = {channel.name: [] for channel in channels}
        self.leads = {channel.name: 0.0 for channel in channels}
        self.count, self.rows, self.starts, self.explained = 0, 0, [], []
        self.shown = np.zeros(0, int)
        """Of each row the first one that shows its place: that of the row it closed a loop with."""

    @property
    def weights(self):
        """Of each channel: its trust, times the sum of its leads so far if any leads."""
        trust = {channel.name: channel.trust for channel in self.channels}
        leading = {name: trust[name] * self.leads[name] for name in trust}
        weights = leading if any(leading.values()) else trust
        return {name: weight / sum(weights.values()) for name, weight in weights.items()}

    def update(self, descriptors, starts=False):
        """Looks for the place of the next frame among the earlier ones, then stores it."""
        anchors = {
            channel.name: np.asarray(descriptors[channel.name]).reshape(-1, *channel.shape)
            for channel in self.channels
        }
        centres = {name: array[len(array) // 2] for name, array in anchors.items()}
        self.arrive(starts)
        step = self.step(anchors, centres)
        self.store(centres, self.shown[step[1]] if step[0] == "accepted" else self.count)
        return step

    def extend(self, descriptors, starts):
        """Stores frames as if they had come, without results."""
        for row, first in enumerate(starts):
            self.arrive(first)
            self.store({name: array[row] for name, array in descriptors.items()}, self.count)

    def model(self):
        """Of the rows that are states: forwards and, as a decoy, backwards."""
        stretches = np.searchsorted(self.starts, np.arange(self.rows), side="right")
        return Model(tuple(stretches.tolist()), MOTION, (FORWARDS, BACKWARDS))

    def without_last(self, frames):
        """The rows but so many last frames of the present stretch: others are never recent."""
        return max(self.starts[-1], self.count - frames)

    def arrive(self, starts):
        """What comes before a frame: a new stretch, and more states, not believed yet."""
        if not self.starts or starts:
            if self.starts:
                self.explained.append(self.tracks.explained)
            self.starts.append(self.count)
            self.rows = self.without_last(min(BESIDE, self.exclude))
            self.states, self.moving = self.model().start(), False
            self.tracks = Tracks(self.exclude, len(self.channels) == 1)
            self.neighbours, self.fits, self.repeats = [], [], Repeats(self.exclude)
        mapped, fresh = self.states[:-1].reshape(2, len(SPEEDS), self.rows), self.rows
        self.rows = max(self.rows, self.without_last(min(BESIDE, self.exclude)))
        mapped = np.pad(mapped, ((0, 0), (0, 0), (0, self.rows - fresh)))
        self.states = np.append(mapped.ravel(), self.states[-1])

    def filter(self, likelihood):
        """``(R,)`` the probability of each row after a frame."""
        model = self.model()
        before = model.after(self.states) if self.moving else self.states
        self.states, _ = model.updated(before, model.emission(likelihood[: self.rows]))
        self.moving = True
        return model.rows(self.states)

    def store(self, centres, shown):
        self.shown = np.append(self.shown, shown)
        for name, frames in self.frames.items():
            frames.append(centres[name])
        self.count += 1

    def step(self, anchors, centres):
        first, old = self.channels[0].name, self.without_last(self.exclude)
        described = np.array([frame.any() for frame in self.frames[first]], bool)
        too_few = np.count_nonzero(described[:old]) < 2
        if not centres[first].any():
            if not too_few:
                self.filter(np.ones(self.rows))
            return "empty_frame", None, None, None, ()
        if not described.any():
            return "no_candidate", None, None, None, ()
        scores = self.scores(anchors, 0 if too_few else old)
        scores[~described] = -np.inf
        near = nearness(scores)
        self.repeats.after(near[self.starts[-1] :])
        if too_few:
            return "too_recent", None, None, None, ()
        seen = near[:old][np.isfinite(near[:old])]
        mean, deviation = seen.mean(), seen.std()
        differ = deviation > MIN_SPREAD and np.ptp(seen) > MIN_SPREAD
        likelihood = self.likelihood(near, mean, deviation) if differ else np.ones(len(near))
        step = self.result(self.filter(likelihood), scores, old)
        if step[0] == "accepted" and differ:
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
        return fused(scores, self.weights, old or self.count)

    def likelihood(self, near, mean, deviation):
        """``(N,)``, how much likelier a frame is at each row than at a new place."""
        start, z = self.starts[-1], (near - mean) / deviation
        same, candidates = z[start:], max(0, len(z) - self.starts[-1] - self.exclude)
        previous = len(same) - max(1, self.exclude // STRIDE)
        if previous >= 0 and np.isfinite(same[previous]):
            self.neighbours = [*self.neighbours, same[previous]][-MEMORY:]
        usual = np.quantile(self.neighbours, 0.25) if self.neighbours else 0.0
        by_chance = math.sqrt(2 * math.log(max(2, len(z))))
        level = max(MOTION.level, LOOPS["level_fraction"] * usual, by_chance)
        self.tracks.after(near[start:], candidates)
        explained = np.repeat(np.array(self.explained), np.diff(self.starts)) / deviation
        weight, fit = self.fit()
        earlier = exp(weight * (z[:start] - np.maximum(fit, explained)))
        evidence, margin = LOOPS["evidence"] / level, LOOPS["repeat_margin"] / deviation
        likely = exp(evidence * (same - level))
        repeats = (self.repeats.highest[: len(same)] - mean) * margin - level
        likely[:candidates] *= np.exp(-evidence * np.maximum(0, repeats))[:candidates]
        if self.tracks.returning:
            likely[:candidates] = np.maximum(likely, exp(weight * (same - fit)))[:candidates]
        return np.concatenate((earlier, likely))

    def fit(self):
        """The weight and the level of rows of another stretch."""
        enough = len(self.channels) > 1 and len(self.fits) >= LEAST_KNOWN
        level = LOOPS["fit"] * np.median(self.fits) if enough else 0.0
        if level > MOTION.level:
            return LOOPS["fit_weight"] * MOTION.weight, level
        return MOTION.weight, MOTION.level

    def result(self, rows, scores, old):
        """The step, by the probabilities of the rows."""
        candidate = int(np.where(np.isfinite(scores[:old]), rows[:old], -1).argmax())
        at_old, recent, places = rows[:old].sum(), rows[old:].sum(), []
        left, row, shown = rows[:old].copy(), candidate, self.shown[:old]
        for _ in range(MAX_PLACES):
            near = np.abs(np.arange(old) - row) <= RADIUS_ROWS
            near |= np.abs(shown - shown[row]) <= RADIUS_ROWS
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
        likely = [place for place in places if place[1] >= LOOPS["least_place"]]
        return reason, candidate, scores[candidate], probability, tuple(likely)


def exp(logarithm):
    return np.exp(np.minimum(logarithm, MAX_LOG))
