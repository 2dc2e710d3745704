"""Loop closures in a stream of descriptors; see `ssrvlad_torch.LoopDetector`."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import motion, stretches
from .model import Seen
from .motion import GAP, LEVEL, MAX_LOG
from .scores import FEATURES, HOG, LABEL_SHAPES, fused, lead, nearness, weights_of
from .stream import Map, SignMap
from .stretches import is_elsewhere, is_gap
from .tracks import Tracks

Floats = npt.NDArray[np.float32]

UNMAPPED, CHANGE, WEIGHT = 0.3, 0.01, 0.25
"""Probabilities of a jump to a new place and of a changed speed, and the weight of a z-score."""
NEAR = 5
"""Rows on each side of a row that show its place."""
EVIDENCE, LEVEL_FRACTION, NEIGHBOURS = 3.0, 0.9, 1000
"""For rows of the same stretch: what twice the level counts; and the level, as a fraction of the
z-score that three quarters of the last frames have with their previous frame."""
STRIDE = 50
"""The previous frame is one frame before where 50 are excluded, and two where 100 are."""
PLACES, LEAST = 5, 0.01
"""A result lists at most so many places, each with at least this probability."""
RECENT = 10
"""Least age, in frames, of an excluded frame that can be the present place."""

MARGIN, APART, TRACK = 1.2, 5, 15
"""A row counts as seen again where it is so much nearer than different places of its street are:
excluded frames that are a fifth of them apart, or more, by the mean over so many frames."""

_MIN_SPREAD = 1e-6


class Settings(NamedTuple):
    """The settings of the detector, as in `ssrvlad_torch.LoopConfig`: the last `exclude` frames are
    no candidates, and a loop has at least the probability `threshold`.
    """

    exclude: int = 50
    threshold: float = 0.8


class Place(NamedTuple):
    """An old frame, and the probability that the place is near it."""

    frame: str
    probability: float


class Loop(NamedTuple):
    """The result of a frame, see `ssrvlad_torch.loops.result.LoopResult`; without poses, `ahead` is
    always `None`."""

    frame: str
    reason: str
    candidate: str | None = None
    score: float | None = None
    probability: float | None = None
    ahead: float | None = None
    candidates: tuple[Place, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The fields by name, for JSON."""
        return {**self._asdict(), "candidates": [place._asdict() for place in self.candidates]}


class Filter:
    """A hidden Markov model over the rows of the map, the same rows run backwards, and a new place.

    Cells are the rows in their order, with empty cells between sequences, so that no step leads
    from one sequence into the next.
    """

    def __init__(self) -> None:
        self.cells = np.empty(0, np.int64)
        self.inside = np.zeros(GAP, np.float32)
        self.restart()

    def extend(self, starts_sequence: bool) -> None:
        """Appends a row."""
        fresh = np.zeros(1 + GAP * starts_sequence, np.float32)
        self.inside = np.concatenate((self.inside, fresh))
        self.cells = np.append(self.cells, len(self.inside) - 1 - GAP)
        self.inside[self.cells[-1]] = 1
        more = np.zeros((*self.mapped.shape[:2], len(fresh)), np.float32)
        self.mapped = np.concatenate((self.mapped, more), axis=2)

    def restart(self) -> None:
        """Forgets the place: the next frame starts another sequence."""
        self.unmapped = UNMAPPED if len(self.cells) else 1.0
        self.mapped = motion.start(self.inside, self.unmapped)
        self._starting = True

    def step(self, log_likelihood: Floats) -> Floats:
        """The probability of each row ``(rows,)`` after the next frame.

        Args:
            log_likelihood: ``(rows,)``, of the frame, -inf where there can be no match.
        """
        if not self._starting and len(self.cells):
            before = self.mapped, self.unmapped
            self.mapped, self.unmapped = motion.after(*before, self.inside, UNMAPPED, CHANGE)
        self._starting = False
        likelihood = np.zeros_like(self.inside)
        likelihood[self.cells] = np.exp(np.minimum(log_likelihood, MAX_LOG))
        mapped = self.mapped * likelihood
        total = float(mapped.sum()) + self.unmapped
        self.mapped, self.unmapped = mapped / np.float32(total), self.unmapped / total
        rows: Floats = self.mapped[0].sum(axis=0)[self.cells]
        return rows


class Repeats:
    """For each frame of a sequence, the highest nearness of the frames around it to others of the
    same street, see `ssrvlad_torch.loops.repeats`."""

    def __init__(self, exclude: int) -> None:
        self._nearest, self._farthest = max(1, exclude // APART), exclude
        self._last: list[Floats] = []
        self._highest = np.empty(0, np.float32)

    def after(self, near: Floats) -> Floats:
        """``(N,)``, by the nearness ``(N,)`` of the next frame to all earlier ones."""
        more = len(near) + 1 - len(self._highest)
        self._highest = np.append(self._highest, np.full(more, -np.inf, np.float32))
        rows = len(near) - np.arange(self._nearest, min(self._farthest, len(near)) + 1)
        # as many as there are, and one that is beside the last
        distances = max(0, min(self._farthest + 1 - self._nearest, len(rows) + 1))
        seen = np.full(distances + 2, -np.inf, np.float32)
        seen[1 : len(rows) + 1] = near[rows]
        widest = np.maximum(np.maximum(seen[:-2], seen[1:-1]), seen[2:])
        self._last = [*self._last, widest][-TRACK:]
        shared = min(len(rows), *map(len, self._last))
        if len(self._last) == TRACK and shared:
            track = np.mean([each[:shared] for each in self._last], axis=0)
            highest = self._highest
            highest[-TRACK:] = np.maximum(highest[-TRACK:], track.max())
            for age in range(TRACK):
                here = rows[:shared][rows[:shared] >= age] - age
                highest[here] = np.maximum(highest[here], track[: len(here)])
        earlier: Floats = self._highest[:-1]
        return earlier


class Detector:
    """Decides for each frame of a stream whether its place was seen before. Where the frames have
    several channels, their scores are fused, by the leads of their first candidates so far."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.map, self.filter = Map(), Filter()
        self.signs: SignMap | None = None
        self.hog: Map | None = None
        self.start, self.neighbours = 0, list[float]()
        self.starts = set[int]()
        self.frames: list[str] = []
        self._recent: deque[tuple[float, list[Any]]] = deque(maxlen=stretches.RECENT)
        self._leads: dict[str, float] = {}

    def update(self, frame: str, seen: Seen, stamp: float = math.nan) -> Loop:
        """Looks for the place of the next frame among the earlier frames, then stores it.

        Args:
            frame: its id, ``<sequence>/<name>``.
            seen: its descriptor ``(D,)`` of length 1, or zero for an empty frame, or ``(S, D)``
                from S anchors with the usual one in the middle; and its features and HOG, which all
                frames of a stream have or none.
            stamp: seconds, not less than those of earlier frames of the sequence, if it is known.
        """
        swept, signs, hog = np.atleast_2d(seen.descriptor), seen.features, seen.hog
        if not self.frames:
            self.signs = None if signs is None else SignMap(signs.shape)
            self.hog = None if hog is None else Map()
            self._leads = dict.fromkeys(seen.channels, 0.0)
        now = [swept[len(swept) // 2], *(each for each in (signs, hog) if each is not None)]
        other = not self.frames or _sequence(frame) != _sequence(self.frames[-1])
        if other or self._breaks(stamp, now):
            self._start_stretch()
        self._recent.append((stamp, now))
        products = self.signs.products(signs) if self.signs else None
        result = self._step(frame, swept, (signs, products), hog)
        self.frames.append(frame)
        self.map.append(now[0])
        if self.signs:
            self.signs.append(signs, products)
        if self.hog:
            self.hog.append(hog)
        return result

    def _breaks(self, stamp: float, now: list[Any]) -> bool:
        stamps = np.array([each for each, _ in self._recent])
        channels = zip(*(each for _, each in self._recent), strict=True)
        return is_gap(stamps, stamp) and is_elsewhere(
            np.stack([*before, last]) for before, last in zip(channels, now, strict=True)
        )

    def _start_stretch(self) -> None:
        """The next frame starts another stretch."""
        self.filter.restart()
        for each in filter(None, (self.map, self.signs, self.hog)):
            each.start_sequence()
        self.start, self.neighbours = len(self.frames), []
        self.starts.add(self.start)
        self.repeats, self.tracks = Repeats(self.settings.exclude), Tracks()
        self._recent.clear()

    def _step(self, frame: str, swept: Floats, signs: tuple[Any, Any], hog: Any) -> Loop:
        exclude = self.settings.exclude
        old = max(0, len(self.frames) - exclude)
        for row in range(len(self.filter.cells), len(self.frames) - min(RECENT, exclude)):
            self.filter.extend(row in self.starts)
        empty, described = not swept[len(swept) // 2].any(), ~self.map.empty
        too_few = np.count_nonzero(described[:old]) < 2
        if too_few and (empty or not described.any()):
            return Loop(frame, "empty_frame" if empty else "no_candidate")
        if empty:
            self.filter.step(np.zeros(len(self.filter.cells), np.float32))
            return Loop(frame, "empty_frame")
        scores = self._scores(swept, signs, hog, 0 if too_few else old)
        near = nearness(scores)
        repeats = self.repeats.after(near[self.start :])
        if too_few:
            return Loop(frame, "too_recent")
        candidates = near[:old][np.isfinite(near[:old])]
        mean, spread = candidates.mean(), max(_MIN_SPREAD, float(candidates.std()))
        likelihood = np.zeros_like(near)
        if spread > _MIN_SPREAD:
            z, repeats = (near - mean) / spread, (repeats - mean) / spread
            likelihood = self._log_likelihood(z, repeats, near)
        rows = self.filter.step(likelihood[: len(self.filter.cells)])
        candidate = int(np.where(np.isfinite(scores[:old]), rows[:old], -1).argmax())
        around = rows[:old][max(0, candidate - NEAR) : candidate + NEAR + 1]
        probability = min(1.0, float(around.sum()))
        reason = self._reason(probability, float(rows[:old].sum()), float(rows[old:].sum()))
        self.tracks.decided(reason == "accepted")
        name, score = self.frames[candidate], float(scores[candidate])
        places = self._places(rows[:old].copy(), candidate)
        return Loop(frame, reason, name, score, probability, candidates=places)

    def _places(self, left: Floats, row: int) -> tuple[Place, ...]:
        """The most probable places by the probabilities of the old rows; the first is given."""
        places = list[Place]()
        while len(places) < PLACES:
            near = slice(max(0, row - NEAR), row + NEAR + 1)
            probability = min(1.0, float(left[near].sum()))
            if probability < LEAST:
                break
            places.append(Place(self.frames[row], probability))
            left[near] = 0
            row = int(left.argmax())
        return tuple(places)

    def _scores(self, swept: Floats, signs: tuple[Any, Any], hog: Any, old: int) -> Floats:
        """``(rows,)`` float32 scores of a frame, scaled by those of the old frames, if any."""
        parts = {LABEL_SHAPES: self.map.scores(swept)}
        if self.signs:
            parts[FEATURES] = self.signs.scores(*signs)
        if self.hog:
            parts[HOG] = self.hog.scores(hog[None])
        if len(parts) == 1:
            return parts[LABEL_SHAPES]
        for name, scores in parts.items():
            self._leads[name] += max(0.0, lead(scores[:old]))
        return fused([*parts.values()], weights_of(self._leads), old or None).astype(np.float32)

    def _log_likelihood(self, z: Floats, repeats: Floats, near: Floats) -> Floats:
        """``(rows,)``, of a frame by its z-scores and its nearness with all earlier frames, and by
        the z-scores that different places of the streets of this stretch have."""
        previous = len(z) - max(1, self.settings.exclude // STRIDE)
        if self.start <= previous and np.isfinite(z[previous]):
            self.neighbours.append(float(z[previous]))
        quartile = np.quantile(self.neighbours[-NEIGHBOURS:], 0.25) if self.neighbours else 0.0
        level = max(LEVEL, LEVEL_FRACTION * quartile, math.sqrt(2 * math.log(max(2, len(z)))))
        log_likelihood = np.float32(WEIGHT) * (z - np.float32(LEVEL))
        same = np.minimum(np.float32(EVIDENCE) * (z[self.start :] / level - 1), MAX_LOG)
        doubt = EVIDENCE * np.maximum(MARGIN * repeats / level - 1, 0).astype(np.float32)
        old = max(0, len(same) - self.settings.exclude)
        same[:old] -= doubt[:old]
        if self._returning(near[self.start :], old):
            others = np.minimum(log_likelihood[self.start :], MAX_LOG)
            same[:old] = np.maximum(same[:old], others[:old])
        log_likelihood[self.start :] = same
        return log_likelihood

    def _returning(self, near: Floats, old: int) -> bool:
        """Whether old rows of the same stretch may count as those of others do; with several
        channels."""
        if len(self._leads) == 1:
            return False
        self.tracks.after(near, old)
        return self.tracks.returning

    def _reason(self, probability: float, old: float, recent: float) -> str:
        threshold = self.settings.threshold
        if probability >= threshold:
            return "accepted"
        if recent > max(old, 1 - old - recent):
            return "too_recent"
        return "ambiguous" if old >= threshold else "below_threshold"


def _sequence(frame: str) -> str:
    return frame.rpartition("/")[0]
