"""Tracker: the place of a live stream among its own frames, by a Bayes filter."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..channels.live_vectors import GrowingArray
from ..recognition.filter import Filter
from ..recognition.fusion import fused, weights_of, z_lead
from ..recognition.motion import MIN_SPREAD, Motion, likelihoods, moments, nearness
from .config import LoopConfig
from .memory import Described, Memory
from .repeats import MARGIN, Repeats
from .result import LoopResult, Place, Reason
from .tracks import Tracks

MOTION = Motion(change=0.01, jump=0.01, unmapped=0.3, weight=0.25, level=0.5)
"""How a stream moves along its own frames, and those frames run backwards."""

EVIDENCE, LEVEL_FRACTION = 3.0, 0.9
"""For frames of the same stretch, which share light and network: the level is a fraction of the
z-score that three quarters of the last `NEIGHBOURS` frames have with their previous frame, and at
least the highest that so many frames have by chance; twice the level counts so much. These and the
settings of `loops.repeats` were chosen on synthetic cities of which docs/loops.md measures none."""

NEIGHBOURS = 1000

STRIDE = 50
"""The more frames a stream excludes, the denser it is. Where it excludes 50, the previous frame is
one frame before; where it excludes 100, two."""

NEAR = 5
"""Frames on each side of a frame that show the same place."""

PLACES, LEAST = 5, 0.01
"""A result lists at most so many places, each with at least this probability."""

RECENT = 10
"""Least age, in frames, of an excluded frame that can be the present place."""


class Tracker:
    """The filter of `LoopDetector` over the frames of a memory, to which the detector appends."""

    def __init__(self, config: LoopConfig, memory: Memory) -> None:
        self._config, self._memory = config, memory
        self._leads = dict.fromkeys(memory.lives, 0.0)
        self._filter = Filter(motion=MOTION)
        self.start_stretch()

    @property
    def weights(self) -> dict[str, float]:
        """The present weights of the channels by their names, see `fusion.weights_of`."""
        return weights_of(self._leads, self._memory.trust)

    def start_stretch(self) -> None:
        """Forgets the place: the next frame starts another stretch."""
        self._filter.restart()
        self._start, self._neighbours = self._memory.start, GrowingArray(np.float64)
        self._repeats = Repeats(self._config.exclude)
        self._tracks = Tracks()

    def extend(self, frames: int) -> None:
        """Makes states of the first frames of the memory, but not of the most recent of them."""
        last = max(0, frames - min(RECENT, self._config.exclude))
        self._filter.extend(self._memory.stretches[len(self._filter) : last])

    def step(self, frame: str, swept: Described) -> LoopResult:
        """The result of the next frame, by its descriptors from S anchors, the usual one in the
        middle."""
        frames, exclude = len(self._memory), self._config.exclude
        old = max(0, frames - exclude)
        self.extend(frames)
        first = next(iter(swept.values()))
        described, empty = ~self._memory.first.empty, not first[len(first) // 2].any()
        if np.count_nonzero(described[:old]) < 2:
            if empty:
                return LoopResult(frame, Reason.EMPTY_FRAME)
            if not described.any():
                return LoopResult(frame, Reason.NO_CANDIDATE)
            scores = self._scores(swept, 0)
            self._repeats.after(nearness(scores[self._start :]).numpy())
            return LoopResult(frame, Reason.TOO_RECENT)
        if empty:
            self._filter.step(torch.full((len(self._filter),), -torch.inf))
            return LoopResult(frame, Reason.EMPTY_FRAME)
        scores = self._scores(swept, old)
        likelihood = self._likelihood(scores, moments(scores[:old]))
        self._filter.update(self._filter.in_cells(likelihood[: len(self._filter)]))
        rows = self._filter.rows()
        candidate = int(rows[:old].masked_fill(scores[:old] == -torch.inf, -1).argmax())
        near = slice(max(0, candidate - NEAR), min(candidate + NEAR + 1, old))
        probability = min(1.0, float(rows[near].sum()))
        reason = self._reason(probability, float(rows[:old].sum()), float(rows[old:].sum()))
        self._tracks.decided(reason is Reason.ACCEPTED)
        ahead = self._ahead(candidate, near, rows) if reason is Reason.ACCEPTED else None
        name, score = self._memory.frames[candidate], float(scores[candidate])
        places = self._places(rows[:old], candidate)
        return LoopResult(frame, reason, name, score, probability, ahead, places)

    def _places(self, rows: Tensor, row: int) -> tuple[Place, ...]:
        """`LoopResult.candidates`, by the probabilities of the old rows; the first is given."""
        places, left = list[Place](), rows.clone()
        while len(places) < PLACES:
            near = slice(max(0, row - NEAR), row + NEAR + 1)
            probability = min(1.0, float(left[near].sum()))
            if probability < LEAST:
                break
            places.append(Place(self._memory.frames[row], probability))
            left[near] = 0
            row = int(left.argmax())
        return tuple(places)

    def _scores(self, swept: Described, old: int) -> Tensor:
        """``(N,)`` scores of a frame by all channels, scaled by those of the old frames, if any."""
        lives = self._memory.lives
        scores = [torch.from_numpy(live.scores(swept[name])) for name, live in lives.items()]
        if len(scores) == 1:
            return scores[0]
        for name, each in zip(self._leads, scores, strict=True):
            self._leads[name] += max(0.0, z_lead(each[:old]))
        return fused(scores, [*self.weights.values()], old or None)

    def _likelihood(self, scores: Tensor, spread: tuple[float, float]) -> Tensor:
        """``(N,)``, see `motion.likelihoods`. The level of frames of the same stretch is the
        higher, the more alike neighbouring frames are and the more their street repeats."""
        mean, deviation = spread
        own = scores[self._start :]
        near = nearness(own)
        repeats = self._repeats.after(near.numpy())
        candidates = max(0, len(own) - self._config.exclude)
        if deviation <= MIN_SPREAD:
            return likelihoods(scores, MOTION, spread)
        previous = len(own) - max(1, self._config.exclude // STRIDE)
        if previous >= 0 and bool(near[previous] > -torch.inf):
            self._neighbours.append((float(near[previous]) - mean) / deviation)
        z_scores = self._neighbours.values[-NEIGHBOURS:]
        by_chance = math.sqrt(2 * math.log(max(2, len(scores))))
        alike = LEVEL_FRACTION * float(np.quantile(z_scores, 0.25)) if len(z_scores) else 0.0
        level = max(MOTION.level, alike, by_chance)
        same = replace(MOTION, weight=EVIDENCE / level, level=level)
        above = torch.from_numpy(repeats).sub_(mean).mul_(MARGIN / deviation).sub_(level)
        others = likelihoods(scores, MOTION, spread)
        own = likelihoods(own, same, spread)
        own[:candidates] *= above.clamp_(min=0).mul_(-same.weight).exp_()[:candidates]
        if self._returning(near, candidates):
            own[:candidates].clamp_(min=others[self._start :][:candidates])
        return torch.cat((others[: self._start], own))

    def _returning(self, near: Tensor, candidates: int) -> bool:
        """Whether old frames of the same stretch may count as those of others do. Label maps alone
        have tracks by chance as close as returns."""
        if len(self._memory.lives) == 1:
            return False
        self._tracks.after(near.numpy(), candidates)
        return self._tracks.returning

    def _reason(self, probability: float, old: float, recent: float) -> Reason:
        """By the probabilities of the candidate's place, all old frames and all recent frames."""
        threshold = self._config.threshold
        if probability >= threshold:
            return Reason.ACCEPTED
        if recent > max(old, 1 - old - recent):
            return Reason.TOO_RECENT
        return Reason.AMBIGUOUS if old >= threshold else Reason.BELOW_THRESHOLD

    def _ahead(self, candidate: int, near: slice, rows: Tensor) -> float | None:
        """`LoopResult.ahead`, by the probabilities of the rows."""
        stretches = self._memory.stretches
        around = range(near.start, near.stop)
        same = [row for row in around if stretches[row] == stretches[candidate]]
        places = self._memory.poses[same, :2]
        if np.isnan(places).any():
            return None
        along = np.cumsum([0.0, *np.hypot(*np.diff(places, axis=0).T)])
        weights = rows[same].double().numpy()
        return float(weights @ (along - along[same.index(candidate)]) / weights.sum())
