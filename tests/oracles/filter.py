"""The hidden Markov model of a sequence along the rows of a map, as formulas."""

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from ssrvlad_torch.native.headers import model

NUMBERS = model("Place")
MAX_LOG, MIN_SPREAD = NUMBERS["most_log"], 1e-6
LEAST_TOTAL = float(np.finfo(np.float32).tiny)
FORWARDS, BACKWARDS = 1, -1
"""Ways to run a map."""

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
PRIOR = np.array([chance for chance, _ in SPEEDS])


class Motion(NamedTuple):
    """How a sequence is expected to move, and how much one frame counts: the probability that its
    speed changes, of a jump to any row or to a place that the map lacks, the part of the latter, of
    staying at such places; the factor of a z-score in the logarithm of the emission, and the
    z-score above which a frame is more likely at a row than at a new place; mean steps a frame."""

    change: float = NUMBERS["change"]
    jump: float = NUMBERS["jump"]
    unmapped: float = NUMBERS["unmapped"]
    stay: float = 1 - 1 / NUMBERS["stretch"]
    weight: float = NUMBERS["weight"]
    level: float = NUMBERS["level"]
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


class Model(NamedTuple):
    """States are an array ``(W * 7 * R + 1,)``: ways, speeds and rows; the last one is a place that
    the map lacks. ``sequences`` has the sequence of each row."""

    sequences: tuple
    motion: Motion
    ways: tuple = (FORWARDS,)

    @property
    def shape(self):
        return len(self.ways), len(SPEEDS), len(self.sequences)

    def enter(self):
        """The probabilities of all states at any row; none of a map without rows."""
        ways, _, rows = self.shape
        share = np.broadcast_to(PRIOR[:, None] / (ways * max(1, rows)), self.shape)
        return np.append(share.ravel(), 0.0)

    def start(self):
        """The probabilities of all states before the first frame."""
        unmapped = self.motion.unmapped if self.sequences else 1.0
        states = (1 - unmapped) * self.enter()
        states[-1] = unmapped
        return states

    def moves(self):
        """Of each way, speed and step its probability, the rows from which it stays in its
        sequence, and where it leads."""
        rows, names = np.arange(len(self.sequences)), np.asarray(self.sequences)
        for (way, sign), speed in product(enumerate(self.ways), range(len(SPEEDS))):
            for step, chance in steps_of(speed, self.motion.rate).items():
                there = rows + sign * step
                inside = (there >= 0) & (there < len(rows))
                inside[inside] = names[rows[inside]] == names[there[inside]]
                yield way, speed, chance, rows[inside], there[inside]

    def after(self, states):
        """The probabilities of all states one frame later. The speed changes, then a step of the
        new speed is taken. What jumps or leaves its sequence is lost: it enters anywhere."""
        motion, unmapped = self.motion, states[-1]
        before = states[:-1].reshape(self.shape)
        turned = motion.change * PRIOR[:, None] * before.sum(1, keepdims=True)
        turned = turned + (1 - motion.change) * before
        moved = np.zeros(self.shape)
        for way, speed, chance, here, there in self.moves():
            moved[way, speed, there] += (1 - motion.jump) * chance * turned[way, speed, here]
        lost = before.sum() - moved.sum()
        later = np.append(moved.ravel(), motion.stay * unmapped + motion.unmapped * lost)
        return later + self.enter() * ((1 - motion.unmapped) * lost + (1 - motion.stay) * unmapped)

    def before(self, future):
        """How likely the later frames are from each state, by how likely they are from the states
        one frame later: the transpose of `after`."""
        motion, unmapped = self.motion, future[-1]
        anywhere = self.enter() @ future
        lost = (1 - motion.unmapped) * anywhere + motion.unmapped * unmapped
        later = future[:-1].reshape(self.shape)
        reached = np.full(self.shape, lost)
        for way, speed, chance, here, there in self.moves():
            reached[way, speed, here] += chance * (later[way, speed, there] - lost)
        any_speed = (PRIOR[:, None] * reached).sum(1, keepdims=True)
        turned = motion.change * any_speed + (1 - motion.change) * reached
        moved = (1 - motion.jump) * turned + motion.jump * lost
        return np.append(moved.ravel(), motion.stay * unmapped + (1 - motion.stay) * anywhere)

    def updated(self, belief, emission):
        """The belief after a frame, and how much likelier the frame is so than alone, as a
        logarithm. After a frame that can be nowhere by the belief, this starts anew."""
        alone = (self.start() * emission).sum()
        if (belief * emission).sum() < LEAST_TOTAL:
            belief = self.start()
        total = (belief * emission).sum()
        if total < LEAST_TOTAL:
            return belief, 0.0
        return belief * emission / total, math.log(total / alone)

    def emission(self, likelihood):
        """In all states, by how much likelier a frame is at each row than at a new place."""
        return np.append(np.broadcast_to(likelihood, self.shape).ravel(), 1.0)

    def rows(self, states):
        """``(R,)``, the probabilities of the rows in the first way."""
        return states[:-1].reshape(self.shape)[0].sum(0)
