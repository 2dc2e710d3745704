"""Filter: the place of a sequence after each of its frames, by the forward algorithm."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .motion import BACKWARDS, CELLS, FORWARDS, SPEEDS, Motion, likelihoods, moved, prior_of_speeds

_HIGHEST = 1.001
"""The highest cosine that rounding can give."""
_ROOM = 8
"""A map that grows has room for an eighth more."""


class Belief(NamedTuple):
    """Probabilities of the places of a frame.

    Attributes:
        mapped: ``(W, 7, cells)`` float32, by way, speed and cell.
        cells: ``(cells,)`` float32, the sum of ``mapped`` over the speeds of the first way.
        decoys: of the second way, the sum over all cells; 0 without one.
        unmapped: of a place that the map lacks.
    """

    mapped: Tensor
    cells: Tensor
    decoys: float
    unmapped: float


class Future(NamedTuple):
    """How likely the later frames are from each state of a `Belief`; not normalised."""

    mapped: Tensor
    unmapped: float


class Filter:
    """A hidden Markov model over the rows of a map, which may grow; see `follow`.

    Cells are the rows in their order, with empty cells between sequences, so that no step leads
    from one sequence into the next.

    Args:
        sequences: the sequence of each row; the rows of one stand together and in order.
        motion: how sequences move.
        ways: in which the map is run, one or two of `FORWARDS` and `BACKWARDS`. The second is the
            decoy: it is as likely as the first where frames and rows only happen to be alike.

    Attributes:
        belief: after the last frame.
        gain: how much likelier the frames since `restart` are as a sequence than each alone, as a
            logarithm.

    Examples:
        >>> track = Filter(["drive"] * 30)
        >>> for scores in torch.eye(30)[10:20]:
        ...     track.step(scores)
        >>> track.rows().argmax()
        tensor(19)
    """

    def __init__(
        self,
        sequences: Sequence[str] = (),
        motion: Motion | None = None,
        ways: Sequence[int] = (FORWARDS, BACKWARDS),
    ) -> None:
        self.motion, self._ways = motion or Motion(), ways
        self._cells = torch.zeros(0, dtype=torch.int64)
        self._inside = torch.zeros(self.motion.gap)
        self._rows = 0
        self._sequence: str | None = None
        self._lost: Tensor | None = None
        nothing = torch.zeros(len(ways), len(SPEEDS), self.motion.gap)
        self.belief = Belief(nothing, nothing[0, 0], 0.0, 1.0)
        self.extend(sequences)
        self.restart()

    def __len__(self) -> int:
        return self._rows

    @property
    def _places(self) -> int:
        """The number of rows, in all ways; of an empty map as of one row."""
        return max(1, self._rows) * len(self._ways)

    def extend(self, sequences: Sequence[str]) -> None:
        """Adds rows at the end of the map; the belief in them is 0. There is room for some more
        cells than rows, so that most calls copy nothing."""
        if not sequences:
            return
        gap, rows = self.motion.gap, self._rows + len(sequences)
        changes = [a != b for a, b in zip(sequences, [self._sequence, *sequences], strict=False)]
        first = int(self._cells[self._rows - 1]) + 1 if self._rows else 0
        cells = first + torch.tensor(changes).cumsum(0) * gap + torch.arange(len(sequences))
        if rows > len(self._cells):
            self._cells = F.pad(self._cells, (0, rows + rows // _ROOM - len(self._cells)))
        self._cells[self._rows : rows] = cells
        self._rows, self._sequence, self._lost = rows, sequences[-1], None
        length = int(cells[-1]) + 1 + gap
        if length > len(self._inside):
            more = length + (length // _ROOM if self._rows > len(sequences) else 0)
            more -= len(self._inside)
            self._inside = F.pad(self._inside, (0, more))
            mapped, belief = (F.pad(each, (0, more)) for each in self.belief[:2])
            self.belief = self.belief._replace(mapped=mapped, cells=belief)
        self._inside[cells] = 1

    def restart(self) -> None:
        """Forgets the place: the next frame starts another sequence."""
        unmapped = self.motion.unmapped_at_start(self._rows)
        cells = self._inside * ((1 - unmapped) / self._places)
        mapped = (prior_of_speeds() * cells).repeat(len(self._ways), 1, 1)
        decoys = (1 - unmapped) * (1 - 1 / len(self._ways))
        self.belief = Belief(mapped, cells, decoys, unmapped)
        self._starting, self.gain = True, 0.0

    def step(self, scores: Tensor) -> None:
        """Updates the belief by the scores of the next frame, see `likelihood`."""
        self.update(self.likelihood(scores))

    def update(self, likelihood: Tensor) -> None:
        """Updates the belief by the likelihood ``(cells,)`` of the next frame."""
        if self._starting:
            belief, ways = self.belief, len(self._ways)
            mapped, cells = belief.mapped * likelihood, belief.cells * likelihood
            by_way = float(cells.sum())
            total = by_way * ways + belief.unmapped
            decoys = by_way * (ways - 1) / total
            self.belief = Belief(mapped / total, cells / total, decoys, belief.unmapped / total)
        else:
            self.belief, total = self.after(self.belief, likelihood)
        unmapped = self.motion.unmapped_at_start(self._rows)
        alone = (1 - unmapped) * float(likelihood.sum()) / max(1, self._rows) + unmapped
        self.gain += math.log(total / alone)
        self._starting = False

    def rows(self, belief: Belief | None = None) -> Tensor:
        """``(R,)`` float32, the probability of each row; without a belief, in the present one."""
        return (belief or self.belief).cells.index_select(0, self._cells[: self._rows])

    def likelihood(self, scores: Tensor) -> Tensor:
        """``(cells,)`` float32, by scores ``(R,)`` float, see `motion.likelihoods`; 0 between
        sequences. Scores of another shape, NaN or above 1 are a ValueError."""
        if scores.shape != (self._rows,):
            got = tuple(scores.shape)
            raise ValueError(f"expected a score for each of {self._rows} rows, got {got}")
        if len(scores) and not (highest := float(scores.amax())) <= _HIGHEST:
            raise ValueError(f"expected scores of at most 1, as cosines are, got {highest:g}")
        return self.in_cells(likelihoods(scores, self.motion))

    def in_cells(self, rows: Tensor) -> Tensor:
        """``(cells,)``, the values of rows ``(R,)`` in their cells; 0 between sequences."""
        return torch.zeros_like(self._inside).index_copy_(0, self._cells[: self._rows], rows)

    def after(self, belief: Belief, likelihood: Tensor) -> tuple[Belief, float]:
        """The belief one frame later, by its likelihood ``(cells,)``, and how likely it was."""
        if not self._rows:
            return belief._replace(decoys=0.0, unmapped=1.0), 1.0
        mapped = moved(belief.mapped, self.motion, self._ways)
        cells = mapped.sum(1)
        lost = max(0.0, 1 - belief.unmapped - float((cells @ self._inside).sum()))
        any_row, unmapped = self.motion.off_track(lost, belief.unmapped)
        each = any_row / self._places
        cells.add_(each).mul_(likelihood)
        by_way = cells.sum(1).tolist()
        total = sum(by_way) + unmapped
        factors = (likelihood / total).split(CELLS)
        for block, factor in zip(mapped.split(CELLS, 2), factors, strict=True):
            block.add_(prior_of_speeds() * each).mul_(factor)
        decoys = sum(by_way[1:]) / total
        return Belief(mapped, cells[0].div_(total), decoys, unmapped / total), total

    def before(self, likelihood: Tensor, future: Future) -> Future:
        """The future one frame earlier, by the later likelihood ``(cells,)``."""
        weighted = future.mapped * likelihood
        any_row = float((prior_of_speeds() * weighted).sum()) * (1 / self._places)
        lost, unmapped = self.motion.off_track_back(any_row, future.unmapped)
        if self._lost is None:
            self._lost = 1 - moved(self.no_future().mapped, self.motion, self._ways, back=True)
        mapped = moved(weighted, self.motion, self._ways, back=True)
        mapped.add_(self._lost, alpha=lost).mul_(self._inside)
        highest = max(unmapped, float(mapped.max()))
        return Future(mapped.div_(highest), unmapped / highest)

    def no_future(self) -> Future:
        """The future from the last frame, with which the backward algorithm starts."""
        return Future(self._inside.expand(len(self._ways), len(SPEEDS), -1), 1.0)
