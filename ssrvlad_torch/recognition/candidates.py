"""Follow over candidates: the filter of `follow` for maps that are too large to score every row.

The belief holds the candidates that a search finds for the present query, and the rows to which
earlier believed ones may have moved. All other rows are one more state, *elsewhere*, with one
probability for each of them and the mean likelihood of a sample of the map. Where all rows are
candidates, the numbers are those of `follow`.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from .follow import NEAR, Mode, Places, compared, ranked, runs, stacked, windows
from .motion import FORWARDS, SPEEDS, Motion, likelihoods, prior_of_speeds, transitions

_MAX_BELIEVED, _MIN_BELIEF = 64, 1e-4
"""The track may go on from the most probable rows, up to this number and down to this belief."""


class Search(Protocol):
    """Finds candidates for queries in a map, and scores any row."""

    def __len__(self) -> int:
        """Number of queries."""

    def candidates(self, query: int) -> Tensor:
        """``(K,)`` int64, rows of the map in any order, each once."""

    def scores(self, query: int, rows: Tensor) -> Tensor:
        """``(N,)`` float32 cosines of rows, -inf where there can be no match."""

    def spread(self, query: int) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of all rows, see `motion.moments`."""

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """``(M,)`` int64 rows that represent all rows, and their scores."""


class State(NamedTuple):
    """The belief after a query.

    Attributes:
        rows: ``(N,)`` int64, rising.
        scores: ``(N,)`` float32, of the query.
        likelihood: ``(N,)`` float64, of the query, see `motion.likelihoods`.
        likelihood_elsewhere: its mean over the other rows.
        mapped: ``(7, N)`` float64, probabilities by speed and row.
        elsewhere: probability of all other rows.
        unmapped: probability of a place that the map lacks.
    """

    rows: Tensor
    scores: Tensor
    likelihood: Tensor
    likelihood_elsewhere: float
    mapped: Tensor
    elsewhere: float
    unmapped: float


class Continuation(NamedTuple):
    """How likely the later queries are from each state; not normalised."""

    mapped: Tensor
    elsewhere: float
    unmapped: float


@torch.no_grad()
def follow_candidates(
    search: Search,
    sequences: Sequence[str],
    part: range | None = None,
    mode: Mode = "offline",
    delay: int = 0,
    top: int = 5,
    motion: Motion | None = None,
    way: int = FORWARDS,
) -> Places:
    """The place of each query of one sequence, of the numbers ``part`` or all, given the others;
    for the other arguments see `follow`. Time for a query depends on its candidates, not on the
    map."""
    track = CandidateFilter(sequences, motion or Motion(), way)
    states = (state for state, _ in track.states(search, part))
    if mode == "offline":
        smoothed = _smoothed(track, [*states])
    else:
        smoothed = [_smoothed(track, window)[0] for window in windows(states, delay)]
    return stacked([track.places(state, top) for state in smoothed], top)


def gain_of_candidates(
    search: Search, sequences: Sequence[str], motion: Motion, way: int, queries: Sequence[int]
) -> float:
    """As `follow.gain`."""
    states = CandidateFilter(sequences, motion, way).states(search, queries)
    return sum(gain for _, gain in states)


class CandidateFilter:
    """The hidden Markov model of `Filter` over candidates."""

    def __init__(self, sequences: Sequence[str], motion: Motion, way: int) -> None:
        self.motion = motion
        self._steps = torch.tensor(motion.steps)[:, None] * way
        self._weights = transitions(motion).double()
        self._prior = prior_of_speeds().double()
        self._starts = torch.tensor([part.start for part in runs(sequences)], dtype=torch.int64)
        self._length = len(sequences)
        self._unmapped = motion.unmapped_at_start(len(sequences))

    def states(
        self, search: Search, part: Sequence[int] | None = None
    ) -> Iterator[tuple[State, float]]:
        """The forward algorithm over one sequence of queries: the belief after each query, and how
        much likelier the query is after those before it than alone, as a logarithm."""
        state = None
        for query in range(len(search)) if part is None else part:
            state, gain = self._step(state, search, query)
            yield state, gain

    def _step(self, before: State | None, search: Search, query: int) -> tuple[State, float]:
        rows = search.candidates(query)
        if before is not None:  # the track may go on from the rows that were believed
            beliefs = before.mapped.sum(0)
            most = beliefs.topk(min(_MAX_BELIEVED, len(beliefs)))
            believed = before.rows[most.indices[most.values >= _MIN_BELIEF]]
            targets = believed + self._steps
            rows = torch.cat((rows, targets[self._inside(believed, targets)]))
        rows = torch.from_numpy(np.unique(rows.numpy())) if len(rows) else torch.tensor([0])
        others = self._length - len(rows)
        if before is None:
            unmapped = self._unmapped
            each = (1 - unmapped) / max(1, self._length)
            mapped, elsewhere = (self._prior * each).expand(-1, len(rows)), each * others
        else:
            mapped, elsewhere, unmapped = self._predicted(before, rows)
        scores, spread = search.scores(query, rows), search.spread(query)
        likelihood = likelihoods(scores, self.motion, spread).double()
        sampled, scores_of_sample = search.sample(query)
        elsewhere_of_sample = scores_of_sample[~torch.isin(sampled, rows)]
        if len(elsewhere_of_sample):
            other = float(likelihoods(elsewhere_of_sample, self.motion, spread).mean())
        else:
            other = 1.0 if others else 0.0
        mapped, elsewhere = mapped * likelihood, elsewhere * other
        total = float(mapped.sum()) + elsewhere + unmapped
        mean = (float(likelihood.sum()) + others * other) / max(1, self._length)
        alone = (1 - self._unmapped) * mean + self._unmapped
        belief = mapped / total, elsewhere / total, unmapped / total
        return State(rows, scores, likelihood, other, *belief), math.log(total / alone)

    def before(self, state: State, later: State, future: Continuation) -> Continuation:
        """The future from a state by the backward algorithm, from the next state and its future."""
        weighted = future.mapped * later.likelihood
        elsewhere = future.elsewhere * later.likelihood_elsewhere
        others = self._length - len(later.rows)
        any_row = float((self._prior * weighted).sum()) + others * elsewhere
        any_row /= max(1, self._length)
        lost, unmapped = self.motion.off_track_back(any_row, future.unmapped)
        places, listed, inside = self._targets(state.rows, later.rows)
        reached = torch.where(listed, weighted[:, places], elsewhere) * inside
        on_track = self._weights.sum(1).T @ inside.double()
        mapped = torch.einsum("tvu,vtn->un", self._weights, reached) + (1 - on_track) * lost
        fresh, known = self._fresh(state.rows, later.rows)
        at_fresh = (self._prior * weighted[:, ~known]).sum(0)
        come = fresh * float(at_fresh.mean()) if fresh else 0.0
        jump = self.motion.jump
        elsewhere = (1 - jump) * (come + (1 - fresh) * elsewhere) + jump * lost
        highest = max(unmapped, elsewhere, float(mapped.max()) if mapped.numel() else 0.0)
        return Continuation(mapped / highest, elsewhere / highest, unmapped / highest)

    def places(self, state: State, top: int) -> Places:
        """The places of one query."""
        beliefs = state.mapped.sum(0)
        scores, indices = ranked(beliefs, state.scores, top, state.rows)
        same = self._sequence(state.rows) == self._sequence(indices[:1])
        near = beliefs[same & ((state.rows - indices[0]).abs() <= NEAR)].sum().float()
        chance = compared(beliefs, state.scores, state.rows, self._length)
        return Places(scores, indices, near, torch.tensor(state.unmapped), chance)

    def _predicted(self, state: State, rows: Tensor) -> tuple[Tensor, float, float]:
        """The belief in rows, in the other rows and in no row, one query after a state."""
        mapped = torch.zeros(len(SPEEDS), len(rows), dtype=torch.double)
        places, listed, inside = self._targets(state.rows, rows)
        come = (self._weights @ state.mapped).transpose(0, 1)
        mapped.index_add_(1, places[listed], come[:, listed])
        left = float((come.sum(0) * (inside & ~listed)).sum())
        fresh, known = self._fresh(state.rows, rows)
        stayed = state.elsewhere * (1 - self.motion.jump)
        if fresh:
            each = stayed * fresh / int((~known).sum())
            mapped[:, ~known] += self._prior * each
        elsewhere = left + stayed * (1 - fresh)
        lost = max(0.0, 1 - state.unmapped - float(mapped.sum()) - elsewhere)
        any_row, unmapped = self.motion.off_track(lost, state.unmapped)
        each = any_row / max(1, self._length)
        elsewhere += each * (self._length - len(rows))
        return mapped + self._prior * each, elsewhere, unmapped

    def _targets(self, rows: Tensor, listed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``(steps, N)``, for the target of each step from each row: its place among the listed
        rows, whether it is among them, and whether it is in the sequence of its row."""
        targets = rows + self._steps
        inside = self._inside(rows, targets)
        places = torch.searchsorted(listed, targets).clamp_(max=max(0, len(listed) - 1))
        return places, inside & (listed[places] == targets), inside

    def _inside(self, rows: Tensor, targets: Tensor) -> Tensor:
        """Whether targets are rows of the map, of the same sequence as their rows."""
        inside = (targets >= 0) & (targets < self._length)
        return inside & (self._sequence(targets) == self._sequence(rows))

    def _fresh(self, rows: Tensor, listed: Tensor) -> tuple[float, Tensor]:
        """Fraction of unlisted rows that became listed; mask of rows listed before."""
        known = torch.isin(listed, rows, assume_unique=True)
        return int((~known).sum()) / max(1, self._length - len(rows)), known

    def _sequence(self, rows: Tensor) -> Tensor:
        """The number of the sequence of each row."""
        return torch.searchsorted(self._starts, rows, right=True)


def _smoothed(track: CandidateFilter, states: Sequence[State]) -> list[State]:
    """The states of queries that follow one another, each given those after it."""
    smoothed: list[State] = []
    future: Continuation | None = None
    for number in reversed(range(len(states))):
        state = states[number]
        if future is None:
            future = Continuation(torch.ones_like(state.mapped), 1.0, 1.0)
        else:
            future = track.before(state, states[number + 1], future)
        mapped = state.mapped * future.mapped
        elsewhere, unmapped = state.elsewhere * future.elsewhere, state.unmapped * future.unmapped
        total = float(mapped.sum()) + elsewhere + unmapped
        mapped, elsewhere, unmapped = mapped / total, elsewhere / total, unmapped / total
        smoothed.append(state._replace(mapped=mapped, elsewhere=elsewhere, unmapped=unmapped))
    return smoothed[::-1]
