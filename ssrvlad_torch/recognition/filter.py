"""Filter: the place of a sequence after each of its frames, by the forward algorithm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .motion import CELLS, GAP, SPEEDS, Motion, evidence, moved, prior_of_speeds

_HIGHEST = 1.001
"""A cosine of 1, however roughly it was computed."""


class Belief(NamedTuple):
    """Probabilities.

    Attributes:
        mapped: ``(8, cells)`` float32, by speed and cell.
        cells: ``(cells,)`` float32, their sums over the speeds.
        unmapped: that of no row of the map.
    """

    mapped: Tensor
    cells: Tensor
    unmapped: float


class Future(NamedTuple):
    """How likely the later frames are from each state, likewise; not normalised."""

    mapped: Tensor
    unmapped: float


class Filter:
    """A hidden Markov model over the rows of a map, which may grow; see `follow`.

    Cells are the rows in their order, with empty ones between sequences, which no speed crosses.

    Args:
        sequences: the sequence of each row; the rows of one stand together and in order.
        motion: what sequences do.

    Attributes:
        belief: after the last `step`.
        gain: how much likelier the frames since `restart` are as a sequence than each alone, as a
            logarithm; not above 0 where they do not follow one another.

    Example:
        >>> track = Filter(["drive"] * 30)
        >>> for scores in torch.eye(30)[10:20]:
        ...     track.step(scores)
        >>> track.rows().argmax()
        tensor(19)
    """

    def __init__(self, sequences: Sequence[str] = (), motion: Motion | None = None) -> None:
        self.motion = motion or Motion()
        self._cells = torch.zeros(0, dtype=torch.int64)
        self._inside = torch.zeros(GAP)
        self._sequence: str | None = None
        self._lost: Tensor | None = None
        self.belief = Belief(torch.zeros(len(SPEEDS), GAP), torch.zeros(GAP), 1.0)
        self.extend(sequences)
        self.restart()

    def __len__(self) -> int:
        return len(self._cells)

    def extend(self, sequences: Sequence[str]) -> None:
        """Adds rows at the end of the map, with no belief in them yet."""
        if not sequences:
            return
        changes = [a != b for a, b in zip(sequences, [self._sequence, *sequences], strict=False)]
        gaps = torch.tensor(changes).cumsum(0) * GAP
        end = len(self._inside) - (0 if self._sequence is None else GAP)
        start = end - (GAP if self._sequence is None else 0)
        cells = start + gaps + torch.arange(len(sequences))
        self._sequence = sequences[-1]
        self._cells = torch.cat((self._cells, cells))
        length = int(cells[-1]) + 1 + GAP
        self._inside = torch.zeros(length)
        self._inside[self._cells] = 1
        self._lost = None
        more = length - len(self.belief.cells)
        mapped, cells = (F.pad(each, (0, more)) for each in self.belief[:2])
        self.belief = self.belief._replace(mapped=mapped, cells=cells)

    def restart(self) -> None:
        """Forgets the place, for another sequence."""
        unmapped = self.motion.unmapped if len(self) else 1.0
        each = (1 - unmapped) / max(1, len(self))
        cells = self._inside * each
        self.belief = Belief(prior_of_speeds() * cells, cells, unmapped)
        self._begins, self.gain = True, 0.0

    def step(self, scores: Tensor) -> None:
        """Takes in the next frame by its scores ``(R,)``, float cosines, -inf where there can be no
        match; another shape, NaN and a score above 1 are a ValueError."""
        self.take(self.evidence(scores))

    def take(self, told: Tensor) -> None:
        """Takes in the next frame by its evidence ``(cells,)``, see `evidence`."""
        first, before = self._begins, self.belief
        self.belief, together = updated(before, told) if first else self.after(before, told)
        chance = self.motion.unmapped if len(self) else 1.0
        alone = (1 - chance) * float(told.sum()) / max(1, len(self)) + chance
        self.gain += math.log(together / alone)
        self._begins = False

    def rows(self, belief: Belief | None = None) -> Tensor:
        """``(R,)`` float32, the probability of each row, now or by a belief."""
        return (belief or self.belief).cells.index_select(0, self._cells)

    def evidence(self, scores: Tensor) -> Tensor:
        """``(cells,)`` float32, see `motion.evidence`; 0 between the sequences."""
        if scores.shape != (len(self),):
            got = tuple(scores.shape)
            raise ValueError(f"expected a score for each of {len(self)} rows, got {got}")
        most = float(scores.amax()) if len(scores) else 0.0
        if not most <= _HIGHEST:
            raise ValueError(f"expected scores of at most 1, as cosines are, got {most:g}")
        return self.spaced(evidence(scores, self.motion))

    def spaced(self, told: Tensor) -> Tensor:
        """``(cells,)``: evidence of rows ``(R,)``, and 0 between the sequences."""
        return torch.zeros_like(self._inside).index_copy_(0, self._cells, told)

    def after(self, belief: Belief, told: Tensor) -> tuple[Belief, float]:
        """The belief one frame later, by the frame's evidence, and how likely that frame was."""
        if not len(self):
            return belief._replace(unmapped=1.0), 1.0
        motion, mapped = self.motion, moved(belief.mapped, self.motion)
        cells = mapped.sum(0)
        lost = max(0.0, 1 - belief.unmapped - float((cells * self._inside).sum()))
        each = (lost * (1 - motion.unmapped) + belief.unmapped * (1 - motion.stay)) / len(self)
        unmapped = lost * motion.unmapped + belief.unmapped * motion.stay
        cells.add_(each).mul_(told)
        total = float(cells.sum()) + unmapped
        for here, by in zip(mapped.split(CELLS, 1), (told / total).split(CELLS), strict=True):
            here.add_(prior_of_speeds() * each).mul_(by)
        return Belief(mapped, cells.div_(total), unmapped / total), total

    def before(self, told: Tensor, after: Future) -> Future:
        """The backward algorithm: how likely the later frames are from each state, by the evidence
        of the next frame and the same for the frames after it; not normalised."""
        motion, seen = self.motion, after.mapped * told
        anywhere = float((prior_of_speeds() * seen).sum()) / max(1, len(self))
        left = (1 - motion.unmapped) * anywhere + motion.unmapped * after.unmapped
        if self._lost is None:
            inside = self._inside.expand(len(SPEEDS), -1)
            self._lost = 1 - moved(inside, motion, back=True)
        mapped = moved(seen, motion, back=True).add_(self._lost, alpha=left).mul_(self._inside)
        unmapped = motion.stay * after.unmapped + (1 - motion.stay) * anywhere
        size = max(unmapped, float(mapped.max()))
        return Future(mapped.div_(size), unmapped / size)

    def no_future(self) -> Future:
        """The start of the backward algorithm."""
        return Future(self._inside.expand(len(SPEEDS), -1), 1.0)


def updated(belief: Belief, told: Tensor) -> tuple[Belief, float]:
    """A belief after a frame was seen, and how likely the frame was."""
    cells = belief.cells * told
    total = float(cells.sum()) + belief.unmapped
    mapped = belief.mapped * (told / total)
    return Belief(mapped, cells.div_(total), belief.unmapped / total), total
