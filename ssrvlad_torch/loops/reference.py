"""Reference: loop closures in a live stream plainly, in NumPy. The oracle of this room.

Each new frame is compared with all earlier ones, each without the mean of its stretch; the scores
of the channels are fused; what the stream itself shows says how alike a frame must be to one seen
before; and a hidden Markov model follows the stream. Every step is written as docs/loops.md tells
it, with whole arrays and float64. The native core computes the same and is held to it by the tests;
without a compiler this file runs instead. It needs no torch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..native.loops import NEAR, PLACES, SCAN_ABOVE, Channel, Found
from ..recognition.motion import MAX_LOG, MIN_SPREAD, ROUNDING, SPEEDS
from ..recognition.reference import MOVES, cosines_of_signs, fused, lead, nearness

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float64]

# --------------------------------------------------------------------- channels: scores of a frame

BEFORE = 10
"""A stretch's mean starts as the mean of all frames before it, weighted as this number of frames:
what its own first frames have in common is their place."""

_LEAST_LENGTH = 1e-9**0.5


def means(frames: Floats, counted: npt.NDArray[np.bool_], starts: Sequence[int]) -> Floats:
    """``(N, ...)``, the mean of the stretch of each frame ``(N, ...)``; not all count in it."""
    found = np.zeros_like(frames)
    for first, last in zip(starts, [*starts[1:], len(frames)], strict=True):
        total, count = frames[first:last].sum(0), counted[first:last].sum()
        if counted[:first].any():
            total = total + BEFORE * frames[:first].sum(0) / counted[:first].sum()
            count = count + BEFORE
        found[first:last] = total / max(1, count)
    return found


def scores_of_vectors(known: Array, swept: Array, starts: Sequence[int]) -> Floats:
    """``(N,)`` cosines of a new frame's best anchor ``(S, D)`` to earlier frames ``(N, D)``, each
    without the mean of its stretch; -inf for an empty frame."""
    frames = np.concatenate((known, swept[len(swept) // 2][None])).astype(np.float64)
    described = np.asarray(frames.any(axis=1), np.bool_)
    mean = means(frames, described, starts)
    rows, anchors = (frames - mean)[:-1], swept - mean[-1]
    anchors[np.abs(anchors).max(axis=1) <= ROUNDING] = 0
    anchors /= np.maximum(np.linalg.norm(anchors, axis=1, keepdims=True), ROUNDING)
    lengths = np.maximum(np.linalg.norm(rows, axis=1), _LEAST_LENGTH)
    scores: Floats = np.where(described[:-1], (rows @ anchors.T).max(axis=1) / lengths, -np.inf)
    return scores


def scores_of_signs(
    known: Array, signs: Array, starts: Sequence[int], levels: int | None = None
) -> Floats:
    """``(N,)`` cosines of a new frame's signs ``(columns, rows, bytes)`` to those of earlier frames
    ``(N, columns, rows, bytes)``, as 1 and -1 without the mean of their stretch, over the columns
    that overlap; of the best move of the new frame. With levels, the numbers of means are rounded
    to so many and one, from -1 to 1."""
    bits = np.unpackbits(np.concatenate((known, signs[None])), axis=-1, bitorder="little")
    numbers = bits.reshape(*bits.shape[:2], -1).astype(np.float64) * 2 - 1
    mean = means(numbers, np.ones(len(numbers), bool), starts)
    if levels is not None:
        mean = 2 * np.floor(mean * levels / 2 + (levels + 1) / 2) / levels - 1
    numbers -= mean
    scores: Floats = cosines_of_signs(numbers[-1:], numbers[:-1], MOVES)[0]
    return scores


# ------------------------------------------------------------ large memories: which rows are chosen

PART = 2
"""Bytes of each cell by which signs are roughly compared with all rows of a large memory. Of chosen
rows all bytes are compared."""

LEVELS = 15
"""The numbers of a mean are rounded to 16 levels for chosen rows: then it is the weighted sum of
four vectors of signs."""

SAMPLE, BEST, LATEST = 0.04, 0.01, 50
"""What is chosen. Evenly spaced rows show what is usual: at most a fraction `SAMPLE` of the size
above which a memory is large, or `LATEST` if that is more. The nearest by the rough scores of each
channel may be the place: a fraction `BEST`. By the last ones the present stretch is judged: at
least `LATEST`."""


def part_of(signs: Array) -> Array:
    """Some bytes of each cell of signs ``(..., bytes)``, evenly spaced."""
    return signs[..., :: max(1, signs.shape[-1] // PART)]


def stride(rows: int, large: int) -> int:
    """How many rows it is from one that shows what is usual to the next."""
    return max(1, math.ceil(rows / max(LATEST, SAMPLE * large)))


def chosen(rough: Sequence[Floats], usual: slice, believed: Floats) -> npt.NDArray[np.bool_]:
    """``(N,)``, whether each row is chosen, by its rough nearness ``(N,)`` by each channel, and by
    how probable rows were before this frame: those that were more probable than by guessing are
    chosen as well, with their neighbours."""
    rows = len(rough[0])
    found = np.zeros(rows, np.bool_)
    found[usual] = found[max(0, min(usual.stop, rows - LATEST)) :] = True
    for near in rough:
        found |= near >= np.quantile(near[usual], 1 - BEST)
    for row in np.flatnonzero(believed * len(believed) > 1):
        found[max(0, row - NEAR) : row + NEAR + 1] = True
    return found


def expected(scores: Floats, rough: Floats, usual: slice) -> Floats:
    """Scores ``(N,)``, where rows that have none get what their rough score lets expect: their
    nearness is on the straight line through that of the ``usual`` rows."""
    near, given = nearness(scores), nearness(rough)
    off, other = near[usual] - near[usual].mean(), given[usual] - given[usual].mean()
    slope = (off * other).mean() / max(other.std(), MIN_SPREAD) ** 2
    line = near[usual].mean() + slope * (given - given[usual].mean())
    return np.where(np.isfinite(scores), scores, 1 - np.exp(-line))


# ----------------------------------------------------------------- stretches: where a stream breaks

GAP, TIMES = 600.0, 10.0
"""A gap is longer than these seconds, in which light does not change much, and than so many times
the usual step."""

LAST_FRAMES, LEAST_FRAMES = 50, 20
"""Frames before a gap that show what is usual: at most and at least."""

LAST, APART = 3, 10
"""The last frames may show the present place; frames that are farther apart show others."""

LIKE = 0.5
"""How alike frames are: 0 as different places, 1 as one frame and the next. After a gap, the same
view is at least so alike; that of a standing camera."""

SPREADS = 3
"""The usual step is at least so many standard deviations of how alike different places are."""


def is_gap(stamps: Sequence[float], stamp: float) -> bool:
    """Whether a stream whose last frames have these stamps pauses before the next. Frames
    without a stamp, which is NaN, do not count."""
    known = [each for each in stamps if not math.isnan(each)]
    if len(known) < LEAST_FRAMES or not stamp - known[-1] > GAP:
        return False
    return bool(stamp - known[-1] > TIMES * np.median(np.diff(known)))


def likeness(frames: Array) -> float:
    """How alike the last of some frames ``(N, *shape)`` of a channel is to those just before it,
    see `LIKE`. Frames too sparse to be like the next are measured by how much places vary."""
    flat = frames.reshape(len(frames), -1)
    if frames.dtype == np.uint8:
        flat = np.unpackbits(flat, axis=1).astype(np.float64) * 2 - 1
    vectors = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), ROUNDING)
    near = nearness(vectors.astype(np.float64) @ vectors.T)
    before = near[:-1, :-1]
    others = before[np.tril_indices(len(before), -APART)]
    usual = np.median(np.diag(before, -1)) - np.median(others)
    step = near[-1, -1 - LAST : -1].max() - np.median(others)
    return float(step / max(usual, SPREADS * others.std(), ROUNDING))


# -------------------------------------------------- repeats: how much a street is alike all along

MARGIN = 1.2
"""A frame counts as seen again where it is so much nearer than different places of its street
are."""

DISTANT = 5
"""Excluded frames that are a fifth of them apart, or more, show different places."""

TRACK = 15
"""Frames over which the nearness of two parts of a drive is averaged, at the same distance or one
frame nearer or farther: single frames of a street with noisy labels are alike by chance."""


class Repeats:
    """A street that repeats runs forwards, so the map run backwards does not tell it from a loop.
    But the frames that a stream excludes cannot be loops: what they have in common with the present
    frame is how alike different places of this street are.

    Attributes:
        highest: ``(N,)``, how self-similar the street is around each frame of a stretch, from
            frames too recent to be loops; -inf where nothing is known.
    """

    def __init__(self, exclude: int) -> None:
        self._nearest, self._farthest = max(1, exclude // DISTANT), exclude
        self._last: list[Floats] = []
        self.highest = np.zeros(0)

    def after(self, near: Floats) -> None:
        """Takes the nearness ``(N,)`` of the next frame to all earlier ones of the stretch."""
        more = len(near) + 1 - len(self.highest)
        self.highest = np.append(self.highest, np.full(more, -np.inf))
        rows = len(near) - np.arange(self._nearest, min(self._farthest, len(near)) + 1)
        # as many distances as there are, and one that is beside the last
        distances = max(0, min(self._farthest + 1 - self._nearest, len(rows) + 1))
        seen = np.full(distances + 2, -np.inf)
        seen[1 : len(rows) + 1] = near[rows]
        widest = np.maximum(np.maximum(seen[:-2], seen[1:-1]), seen[2:])
        self._last = [*self._last, widest][-TRACK:]
        shared = min(len(rows), *map(len, self._last))
        if len(self._last) < TRACK or not shared:
            return
        track = np.mean([each[:shared] for each in self._last], axis=0)
        self.highest[-TRACK:] = np.maximum(self.highest[-TRACK:], track.max())
        for age in range(TRACK):
            here = rows[:shared][rows[:shared] >= age] - age
            self.highest[here] = np.maximum(self.highest[here], track[: len(here)])


# ------------------------------------------------------------- tracks: returns in another light

KEPT = 0.93
"""A track is a mean over frames, in which each counts so much of the next."""

EXPLAINED = 0.9
"""By label maps alone, a new place explains a frame of an earlier stretch that is no nearer than
this quantile of the tracks by chance was in that stretch."""

BY_CHANCE = 1.5
"""A track so many times as close as the closest by chance is a return."""

CLEAR, SAME = 0.12, 0.75
"""Closeness is 0 for different places and 1 for a frame and the next. Where tracks by chance are
closer than the first, places look too alike to be told apart in another light; a track closer than
the second is in the same light. The older half of the excluded frames shows how dense a stream is:
in a slow one, they run beside the last ones as closely as a return in another light would."""

USUAL, EARLIER = 100, 1000
"""Frames that show what is usual, and frames whose closest track is one by chance."""

LEAST_BY_CHANCE, WAIT = 5, 25
"""Frames by chance that must be known; and how long no loop is closed before and after them. A
return that closes none for twice as long is by chance, too."""

_AROUND, _BESIDE, _LEAST_STEP = 50, 10, 0.02


class Tracks:
    """In another light, a frame is much less like the old frame of its place than like the frame
    before. But the two drives run on side by side. The stream itself shows how closely drives do so
    by chance: most frames are at new places."""

    def __init__(self, exclude: int, alone: bool = False) -> None:
        self._exclude, self._alone = exclude, alone
        self._closeness = np.zeros(0)
        self._steps, self._others = list[float](), list[float]()
        self._waiting, self._by_chance = list[float](), list[float]()
        self._since, self._held, self._closest, self._densest = WAIT, 0, 0.0, 0.0

    @property
    def returning(self) -> bool:
        """Whether the last frames run beside old ones in another light; never by label maps alone,
        whose tracks by chance are as close as those of returns."""
        if self._alone or len(self._by_chance) < LEAST_BY_CHANCE:
            return False
        highest = max(self._by_chance)
        is_clear = highest <= CLEAR and BY_CHANCE * highest <= self._closest
        return is_clear and self._densest <= self._closest < SAME

    @property
    def explained(self) -> float:
        """How much nearer than the mean an old frame can be to one of a new place, see
        `EXPLAINED`; 0 where too few tracks by chance are known, or other channels tell places
        apart."""
        if not self._alone or len(self._by_chance) < LEAST_BY_CHANCE:
            return 0.0
        return float(np.quantile(self._by_chance, EXPLAINED)) * self._step

    @property
    def _step(self) -> float:
        """How much nearer than different places a frame is to the next."""
        return max(_LEAST_STEP, float(np.median(self._steps) - np.median(self._others)))

    def after(self, near: Floats, old: int) -> None:
        """Takes the nearness ``(N,)`` of the next frame to all earlier ones of the stretch, of
        which the first are old; -inf where a frame is empty."""
        before, self._closeness = self._closeness, np.zeros(len(near))
        if len(near) < 2 * _BESIDE or near[-1] == -np.inf:
            return
        self._steps = [*self._steps, float(near[-1])][-USUAL:]
        self._others = [*self._others, float(np.median(near[-_AROUND:-_BESIDE]))][-USUAL:]
        known = near[:old][near[:old] > -np.inf]
        if not len(known):
            return
        close = np.where(np.isfinite(near), (near - known.mean()) / self._step, 0)
        self._closeness[len(near) - len(before) :] = KEPT * before
        self._closeness += (1 - KEPT) * close
        self._closest = float(self._closeness[:old].max())
        self._densest = float(self._closeness[old : len(near) - self._exclude // 2].max(initial=0))

    def decided(self, accepted: bool) -> None:
        """Takes whether the frame closes a loop: tracks around one are not by chance, nor are those
        of a camera that stands, nor is, for a while, a return that may still become a loop."""
        self._held = self._held + 1 if self.returning and not accepted else 0
        if 0 < self._held <= 2 * WAIT:
            return
        stands = self._densest >= SAME
        self._since = 0 if accepted or stands else self._since + 1
        if accepted or stands:
            self._waiting = []
        elif self._since > WAIT and self._closest:
            self._waiting.append(self._closest)
            if len(self._waiting) > WAIT:
                self._by_chance = [*self._by_chance, self._waiting.pop(0)][-EARLIER:]


# ------------------------------------------------- the filter: where the stream is among its frames

WAYS = (1, -1)
"""The rows are run forwards and, as a decoy, backwards: what that holds is chance."""

CHANGE, JUMP, UNMAPPED, STAY = 0.01, 0.01, 0.3, 0.97
"""Probabilities: the speed changes; a jump, to any row or to a new place; such a jump leads to a
new place; and to stay at new places."""

WEIGHT, LEVEL = 0.25, 0.5
"""The likelihood of a row of another stretch with the z-score z is exp(WEIGHT * (z - level)),
against that of a new place. The level is at least LEVEL, and what `Tracks` explain by chance."""

FITS, LEAST_FITS, FIT, FIT_WEIGHT = 20, 5, 0.5, 2
"""Once so many of the last loops of a stretch show how well the right rows fit, by their z-score, a
row that fits half as well is as likely as a new place, and a z-score counts twice: the stream has
left the old drive where it no longer fits. Label maps alone fit too unevenly."""

EVIDENCE, LEVEL_FRACTION = 3.0, 0.9
"""For frames of the same stretch, which share light and network. The level is a fraction of the
z-score that three quarters of the last `NEIGHBOURS` frames have with their previous frame, and at
least the highest that so many frames have by chance. A frame at twice the level contributes
EVIDENCE to the log-likelihood. These and the settings of `Repeats` were chosen on synthetic cities
of which docs/loops.md measures none."""

NEIGHBOURS = 1000

STRIDE = 50
"""The more frames a stream excludes, the denser it is. Where it excludes 50, the previous frame is
one frame before; where it excludes 100, two."""

RECENT = 10
"""Least age, in frames, of an excluded frame that can be the present place."""

LEAST = 0.01
"""Least probability of a place that a result lists."""


class Filter:
    """A hidden Markov model over the rows of the stream, the same rows run backwards, and a new
    place.

    Attributes:
        mapped: ``(2, 7, N)``, the belief by way, speed and row.
        unmapped: the belief in a new place.
    """

    def __init__(self) -> None:
        self._stretches = np.zeros(0, int)
        self.mapped = np.zeros((2, len(SPEEDS), 0))
        self.restart()

    @property
    def rows(self) -> int:
        """Their number."""
        return len(self._stretches)

    def extend(self, stretches: Sequence[int]) -> None:
        """Adds rows by the numbers of their stretches; nothing is believed of them."""
        self._stretches = np.append(self._stretches, np.array(stretches, int))
        self.mapped = np.pad(self.mapped, ((0, 0), (0, 0), (0, len(stretches))))

    def restart(self) -> None:
        """Forgets the place: the next frame starts another stretch."""
        self.unmapped = UNMAPPED if self.rows else 1.0
        self.mapped = self._anywhere(1 - self.unmapped)
        self._starting = True

    def _anywhere(self, probability: float) -> Floats:
        prior = np.array([chance for chance, _ in SPEEDS])[:, None]
        each = probability / (len(WAYS) * max(1, self.rows))
        return np.broadcast_to(prior * each, (len(WAYS), len(SPEEDS), self.rows)).copy()

    def step(self, likelihood: Floats) -> Floats:
        """The probability of each row ``(N,)`` after a frame, by how much likelier it is at each
        row ``(N,)`` than at a new place."""
        if not self._starting:
            moved = self._moved()
            lost = max(0.0, 1 - self.unmapped - moved.sum())
            arriving = lost * (1 - UNMAPPED) + self.unmapped * (1 - STAY)
            self.unmapped = lost * UNMAPPED + self.unmapped * STAY if self.rows else 1.0
            self.mapped = moved + self._anywhere(arriving)
        self._starting = False
        self.mapped = self.mapped * likelihood
        total = self.mapped.sum() + self.unmapped
        self.mapped, self.unmapped = self.mapped / total, self.unmapped / total
        found: Floats = self.mapped[0].sum(axis=0)
        return found

    def _moved(self) -> Floats:
        """The belief one frame later, without jumps; what leaves its stretch is lost."""
        later, rows = np.zeros_like(self.mapped), np.arange(self.rows)
        for way, belief in enumerate(self.mapped):
            for speed, (prior, steps) in enumerate(SPEEDS):
                turned = (1 - CHANGE) * belief[speed] + CHANGE * prior * belief.sum(axis=0)
                for step, chance in steps.items():
                    to = rows + WAYS[way] * step
                    inside = (to >= 0) & (to < self.rows)
                    inside[inside] = self._stretches[to[inside]] == self._stretches[inside]
                    later[way, speed, to[inside]] += (1 - JUMP) * chance * turned[inside]
        return later


# --------------------------------------------------------------------------------------- the stream


class Loops:
    """A live stream, as `native.loops.Loops`, which see."""

    def __init__(
        self,
        channels: Sequence[Channel],
        exclude: int = 50,
        threshold: float = 0.8,
        scan_above: int = SCAN_ABOVE,
    ) -> None:
        self.channels, self._exclude, self._threshold = tuple(channels), exclude, threshold
        self._scan_above = scan_above
        self._frames: dict[str, list[Array]] = {each.name: [] for each in channels}
        self._leads = {each.name: 0.0 for each in channels}
        self._stamps, self._starts = list[float](), list[int]()
        self._tracks, self._explained = Tracks(exclude, len(channels) == 1), list[float]()
        self._filter = Filter()

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def _is_large(self) -> bool:
        signs = any(channel.dtype == "uint8" for channel in self.channels)
        return signs and len(self) - self._exclude > self._scan_above

    def _usual(self, old: int) -> slice:
        """The old rows that show what is usual."""
        return slice(0, old, stride(old, self._scan_above) if self._is_large else 1)

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each channel: its trust, times the sum of the leads of its first
        candidates; where none leads, trust decides."""
        trust = {each.name: each.trust for each in self.channels}
        known = {name: trust[name] * self._leads[name] for name in trust}
        chosen = known if any(known.values()) else trust
        return {name: weight / sum(chosen.values()) for name, weight in chosen.items()}

    def descriptors(self, name: str, first: int, last: int) -> Array:
        """``(last - first, *shape)``, a copy, by the channel with a name."""
        return np.array(self._frames[name][first:last])

    def update(
        self,
        descriptors: Mapping[str, Array],
        stamp: float = math.nan,
        starts: bool = False,
        threads: int = 1,
    ) -> Found:
        """Looks for the place of the next frame among the earlier ones, then stores it."""
        swept = {
            each.name: np.asarray(descriptors[each.name]).reshape(-1, *each.shape)
            for each in self.channels
        }
        centres = {name: anchors[len(anchors) // 2] for name, anchors in swept.items()}
        self._arrive(centres, stamp, starts)
        found = self._step(swept, centres)
        self._store(centres, stamp)
        return found

    def extend(self, descriptors: Mapping[str, Array], stamps: Array | None, starts: Array) -> None:
        """Stores frames that are known as if they had come, without results."""
        for row, first in enumerate(starts):
            stamp = math.nan if stamps is None else float(stamps[row])
            centres = {name: each[row] for name, each in descriptors.items()}
            self._arrive(centres, stamp, bool(first))
            self._store(centres, stamp)

    def _arrive(self, centres: Mapping[str, Array], stamp: float, starts: bool) -> None:
        """What comes before a frame: a new stretch, and another state of the filter."""
        if not self._starts or starts or self._breaks(centres, stamp):
            if self._starts:
                self._explained.append(self._tracks.explained)
                self._tracks = Tracks(self._exclude, len(self.channels) == 1)
            self._starts.append(len(self))
            self._neighbours, self._fits = list[float](), list[float]()
            self._repeats = Repeats(self._exclude)
            self._filter.restart()
        last = max(0, len(self) - min(RECENT, self._exclude))
        fresh = np.arange(self._filter.rows, max(last, self._filter.rows))
        self._filter.extend(np.searchsorted(self._starts, fresh, side="right").tolist())

    def _breaks(self, centres: Mapping[str, Array], stamp: float) -> bool:
        first = max(self._starts[-1], len(self) - LAST_FRAMES)
        if not is_gap(self._stamps[first:], stamp):
            return False
        alike = [
            likeness(np.array([*self._frames[name][first:], centres[name]])) for name in centres
        ]
        return bool(np.mean(alike) < LIKE)

    def _store(self, centres: Mapping[str, Array], stamp: float) -> None:
        for name, frames in self._frames.items():
            frames.append(np.array(centres[name]))
        self._stamps.append(stamp)

    def _step(self, swept: Mapping[str, Array], centres: Mapping[str, Array]) -> Found:
        first, old = self.channels[0].name, max(0, len(self) - self._exclude)
        described = np.array([frame.any() for frame in self._frames[first]], bool)
        too_few, empty = np.count_nonzero(described[:old]) < 2, not centres[first].any()
        if empty:
            if not too_few:
                self._filter.step(np.ones(self._filter.rows))
            return Found("empty_frame")
        if not described.any():
            return Found("no_candidate")
        scores = self._scores(swept, 0 if too_few else old)
        scores[~described] = -np.inf
        near = nearness(scores)
        self._repeats.after(near[self._starts[-1] :])
        if too_few:
            return Found("too_recent")
        mean, deviation = self._spread(near, old)
        told = self._likelihood(near, mean, deviation, old) if deviation else np.ones(len(near))
        rows = self._filter.step(told[: self._filter.rows])
        found = self._found(rows, scores, old)
        if found.reason == "accepted" and deviation:
            fit = (near[found.candidate] - mean) / deviation
            self._fits = [*self._fits, float(fit)][-FITS:]
        return found

    def _scores(self, swept: Mapping[str, Array], old: int) -> Floats:
        """``(N,)`` scores of a frame by all channels, scaled by those of the old frames, if any."""
        scores, usual = dict[str, Floats](), self._usual(old or len(self))
        known = {name: np.array(frames) for name, frames in self._frames.items()}
        rough = {
            name: scores_of_signs(part_of(known[name]), part_of(swept[name][0]), self._starts)
            for name, _, dtype, _ in self.channels
            if dtype == "uint8" and self._is_large
        }
        rows = np.ones(len(self), bool)
        if rough:
            believed = self._filter.mapped[0].sum(axis=0)
            rows = chosen([*map(nearness, rough.values())], usual, believed)
        for name, _, dtype, _ in self.channels:
            if dtype == "uint8":
                levels = LEVELS if rough else None
                found = scores_of_signs(known[name], swept[name][0], self._starts, levels)
            else:
                found = scores_of_vectors(known[name], swept[name], self._starts)
            found[~rows] = -np.inf
            scores[name] = expected(found, rough[name], usual) if name in rough else found
            self._leads[name] += max(0.0, lead(scores[name][:old], usual))
        if len(scores) == 1 and not rough:
            return next(iter(scores.values()))
        return fused(scores, self.weights, usual)

    def _spread(self, near: Floats, old: int) -> tuple[float, float]:
        """The mean of the nearness of old rows, and its deviation, 0 if they are equally near."""
        known = near[self._usual(old)]
        known = known[np.isfinite(known)]
        deviation = float(known.std())
        equal = deviation <= MIN_SPREAD or np.ptp(known) <= MIN_SPREAD
        return float(known.mean()), 0.0 if equal else deviation

    def _likelihood(self, near: Floats, mean: float, deviation: float, old: int) -> Floats:
        """``(N,)``, how much likelier a frame is at each row than at a new place, by its nearness.
        The level of frames of the same stretch is the higher, the more alike neighbouring frames
        are and the more their street repeats."""
        start, z = self._starts[-1], (near - mean) / deviation
        own, candidates = z[start:], max(0, len(z) - start - self._exclude)
        previous = len(own) - max(1, self._exclude // STRIDE)
        if previous >= 0 and np.isfinite(own[previous]):
            self._neighbours = [*self._neighbours, float(own[previous])][-NEIGHBOURS:]
        usual = float(np.quantile(self._neighbours, 0.25)) if self._neighbours else 0.0
        by_chance = math.sqrt(2 * math.log(max(2, len(z))))
        level = max(LEVEL, LEVEL_FRACTION * usual, by_chance)
        self._tracks.after(near[start:], candidates)
        explained = np.repeat(np.array(self._explained), np.diff(self._starts)) / deviation
        weight, usually = self._fit()
        levels = np.maximum(usually, explained)
        others = np.exp(np.minimum(weight * (z[:start] - levels), MAX_LOG))
        same = np.exp(np.minimum(EVIDENCE / level * (own - level), MAX_LOG))
        repeats = (self._repeats.highest[: len(own)] - mean) * MARGIN / deviation - level
        same[:candidates] *= np.exp(-EVIDENCE / level * np.maximum(0, repeats))[:candidates]
        if self._tracks.returning:
            returned = np.exp(np.minimum(weight * (own - usually), MAX_LOG))
            same[:candidates] = np.maximum(same, returned)[:candidates]
        return np.concatenate((others, same))

    def _fit(self) -> tuple[float, float]:
        """The weight and the level of rows in another light, see `FIT`."""
        known = len(self.channels) > 1 and len(self._fits) >= LEAST_FITS
        level = FIT * float(np.median(self._fits)) if known else 0.0
        return (FIT_WEIGHT * WEIGHT, level) if level > LEVEL else (WEIGHT, LEVEL)

    def _found(self, rows: Floats, scores: Floats, old: int) -> Found:
        """The result, by the probabilities of the rows."""
        candidate = int(np.where(np.isfinite(scores[:old]), rows[:old], -1).argmax())
        first, last = max(0, candidate - NEAR), min(candidate + NEAR + 1, old)
        probability = min(1.0, float(rows[first:last].sum()))
        at_old, recent = float(rows[:old].sum()), float(rows[old:].sum())
        reason = "below_threshold"
        if probability >= self._threshold:
            reason = "accepted"
        elif recent > max(at_old, 1 - at_old - recent):
            reason = "too_recent"
        elif at_old >= self._threshold:
            reason = "ambiguous"
        self._tracks.decided(reason == "accepted")
        stretch = np.searchsorted(self._starts, candidate, side="right")
        first, last = (
            max(first, self._starts[stretch - 1]),
            min(last, *self._starts[stretch:], last),
        )
        near = tuple(rows[first:last].tolist())
        places = tuple(_places(rows[:old].copy(), candidate))
        return Found(reason, candidate, float(scores[candidate]), probability, places, first, near)


def _places(left: Floats, row: int) -> Iterator[tuple[int, float]]:
    """The most probable places by the probabilities of the old rows; the first is given."""
    for _ in range(PLACES):
        near = slice(max(0, row - NEAR), row + NEAR + 1)
        probability = min(1.0, float(left[near].sum()))
        if probability < LEAST:
            return
        yield row, probability
        left[near] = 0
        row = int(left.argmax())
