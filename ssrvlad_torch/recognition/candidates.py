"""Follow over candidates: the filter of `follow` where the map is too large to score every row.

The belief holds the candidates that a search finds for the present query, and the rows to which
earlier believed ones may have moved. All other rows are one more state, *elsewhere*: spread evenly,
with the mean evidence of a sample of the map. Where all rows are candidates, the numbers are those
of `follow`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from .follow import NEAR, Mode, Places, runs, stacked
from .matching import best_of
from .motion import GAP, SPEEDS, Motion, chances, evidence, prior_of_speeds

STEPS = tuple(range(min(s for _, steps in SPEEDS for s in steps), GAP + 1))

_BELIEVED = 64
"""Rows from which the track may go on where no candidate is found."""
_LEAST = 1e-4


class Search(Protocol):
    """What finds candidates for queries in a map, and scores any row."""

    def __len__(self) -> int:
        """The number of queries."""

    def candidates(self, query: int) -> Tensor:
        """``(K,)`` int64, rows of the map in any order, each once."""

    def scores(self, query: int, rows: Tensor) -> Tensor:
        """``(N,)`` float32 cosines of rows, -inf where there can be no match."""

    def spread(self, query: int) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of all rows, see `motion.moments`."""

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """Rows that stand for all, ``(M,)`` int64, and their scores."""


class State(NamedTuple):
    """The belief after a query.

    Attributes:
        rows: ``(N,)`` int64, rising.
        scores: ``(N,)`` float32, of the query.
        told: ``(N,)`` float64, evidence of the query, see `motion.evidence`.
        told_elsewhere: the mean evidence at the other rows.
        mapped: ``(8, N)`` float64, probabilities by speed and row.
        elsewhere: probability of all other rows.
        unmapped: probability of a place that the map lacks.
    """

    rows: Tensor
    scores: Tensor
    told: Tensor
    told_elsewhere: float
    mapped: Tensor
    elsewhere: float
    unmapped: float


class Future(NamedTuple):
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
) -> Places:
    """Where the queries of one sequence are, each in the light of the others; see `follow`.

    Time for a query depends on its candidates, not on the map.

    Args:
        search: finds candidates and scores rows.
        sequences: the sequence of each row of the map; the rows of one stand together and in order.
        part: numbers of the queries; without, all.
        mode, delay, top, motion: as for `follow`.
    """
    part = range(len(search)) if part is None else part
    track = Track(sequences, motion)
    ahead = len(part) if mode == "offline" else delay
    judged = dict(_judged(track, search, part, ahead))
    return stacked([track.places(judged[query], top) for query in part], top)


def gain(
    search: Search, sequences: Sequence[str], motion: Motion, part: range | None = None
) -> float:
    """How much likelier the queries are as a sequence than each alone, as a logarithm."""
    track, state, total = Track(sequences, motion), None, 0.0
    for query in range(len(search)) if part is None else part:
        state, likelier = track.step(state, search, query)
        total += likelier
    return total


class Track:
    """The transitions of the filter over rows of sequences."""

    def __init__(self, sequences: Sequence[str], motion: Motion | None = None) -> None:
        self.motion = motion or Motion()
        taps = [GAP - step for step in STEPS]
        self._steps = torch.tensor(STEPS)[:, None]
        self._ways = chances(self.motion).double()[:, :, taps].permute(2, 0, 1).contiguous()
        self._prior = prior_of_speeds().double()
        self._starts = torch.tensor([part.start for part in runs(sequences)], dtype=torch.int64)
        self._length = len(sequences)

    def step(self, before: State | None, search: Search, query: int) -> tuple[State, float]:
        """Takes in a query; without a belief before it, the first of its sequence. Gives the
        belief, and how much likelier the query is after those before it than alone, as a
        logarithm."""
        rows = search.candidates(query)
        rows = rows if before is None else torch.cat((rows, self._reached(before)))
        rows = torch.from_numpy(np.unique(rows.numpy()))
        mapped, elsewhere, unmapped = (
            self._anywhere(rows) if before is None else self._predicted(before, rows)
        )
        scores, spread = search.scores(query, rows), search.spread(query)
        told = evidence(scores, self.motion, spread).double()
        told_elsewhere = self._elsewhere(search, query, rows, spread)
        seen = mapped * told
        others = self._length - len(rows)
        total = float(seen.sum()) + elsewhere * told_elsewhere + unmapped
        chance = self.motion.unmapped if self._length else 1.0
        mean = (float(told.sum()) + others * told_elsewhere) / max(1, self._length)
        alone = (1 - chance) * mean + chance
        state = State(
            rows,
            scores,
            told,
            told_elsewhere,
            seen / total,
            elsewhere * told_elsewhere / total,
            unmapped / total,
        )
        return state, math.log(total / alone)

    def before(self, state: State, after: State, future: Future) -> Future:
        """The backward algorithm: how likely the later queries are from each state, by the next
        state and its own future."""
        motion, others = self.motion, self._length - len(after.rows)
        seen = future.mapped * after.told
        apart = future.elsewhere * after.told_elsewhere
        anywhere = float((self._prior * seen).sum()) + others * apart
        anywhere /= max(1, self._length)
        left = (1 - motion.unmapped) * anywhere + motion.unmapped * future.unmapped
        places, there, inside = self._targets(state.rows, after.rows)
        reached = torch.where(there, seen[:, places], apart) * inside
        mapped = torch.einsum("tvu,vtn->un", self._ways, reached)
        kept = self._ways.sum(1).T @ inside.double()
        mapped += (1 - kept) * left
        fresh, there = self._fresh(state.rows, after.rows)
        come = fresh * float((self._prior * seen[:, ~there]).sum(0).mean()) if fresh else 0.0
        elsewhere = (1 - motion.jump) * (come + (1 - fresh) * apart) + motion.jump * left
        unmapped = motion.stay * future.unmapped + (1 - motion.stay) * anywhere
        size = max(unmapped, elsewhere, float(mapped.max()) if mapped.numel() else 0.0)
        return Future(mapped / size, elsewhere / size, unmapped / size)

    def places(self, state: State, top: int) -> Places:
        """Candidates by falling probability, the first of equals first."""
        beliefs = state.mapped.sum(0)
        scored = state.scores > -torch.inf
        among = beliefs.masked_fill(~scored, -torch.inf) if scored.any() else beliefs
        scores, indices = best_of(among, top, state.rows)
        near = torch.tensor(0.0)
        if indices[0] >= 0:
            same = self._sequence(state.rows) == self._sequence(indices[:1])
            near = beliefs[same & ((state.rows - indices[0]).abs() <= NEAR)].sum().float()
        return Places(scores, indices, near, torch.tensor(state.unmapped))

    def _anywhere(self, rows: Tensor) -> tuple[Tensor, float, float]:
        unmapped = self.motion.unmapped if self._length else 1.0
        each = (1 - unmapped) / max(1, self._length)
        mapped = (self._prior * each).expand(-1, len(rows))
        return mapped, each * (self._length - len(rows)), unmapped

    def _predicted(self, state: State, rows: Tensor) -> tuple[Tensor, float, float]:
        """The belief in rows, in the others and in no row, before the query is seen."""
        motion = self.motion
        places, there, inside = self._targets(state.rows, rows)
        come = (self._ways @ state.mapped).transpose(0, 1)
        mapped = torch.zeros(len(SPEEDS), len(rows), dtype=torch.double)
        mapped.index_add_(1, places[there], come[:, there])
        beside = float((come.sum(0) * (inside & ~there)).sum())
        fresh, known = self._fresh(state.rows, rows)
        kept = state.elsewhere * (1 - motion.jump)
        if fresh:
            each = kept * fresh / int((~known).sum())
            mapped[:, ~known] += self._prior * each
        elsewhere = beside + kept * (1 - fresh)
        lost = max(0.0, 1 - state.unmapped - float(mapped.sum()) - elsewhere)
        arriving = lost * (1 - motion.unmapped) + state.unmapped * (1 - motion.stay)
        each = arriving / max(1, self._length)
        unmapped = lost * motion.unmapped + state.unmapped * motion.stay
        others = self._length - len(rows)
        return mapped + self._prior * each, elsewhere + each * others, unmapped

    def _reached(self, state: State) -> Tensor:
        """Rows to which the track may have gone on."""
        beliefs = state.mapped.sum(0)
        most = beliefs.topk(min(_BELIEVED, len(beliefs)))
        rows = state.rows[most.indices[most.values >= _LEAST]]
        targets = rows + self._steps
        inside = self._sequence(targets) == self._sequence(rows)
        return targets[inside & (targets >= 0) & (targets < self._length)]

    def _targets(self, rows: Tensor, among: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """``(steps, N)``, each step from each row: its place among others, whether it is there, and
        whether it is in the map."""
        targets = rows + self._steps
        inside = (targets >= 0) & (targets < self._length)
        inside &= self._sequence(targets) == self._sequence(rows)
        places = torch.searchsorted(among, targets).clamp_(max=max(0, len(among) - 1))
        return places, inside & (among[places] == targets), inside

    def _fresh(self, rows: Tensor, among: Tensor) -> tuple[float, Tensor]:
        """The fraction of the rows elsewhere that is now among others, and which of these were
        known."""
        known = torch.isin(among, rows, assume_unique=True)
        return int((~known).sum()) / max(1, self._length - len(rows)), known

    def _elsewhere(
        self, search: Search, query: int, rows: Tensor, spread: tuple[float, float]
    ) -> float:
        """The mean evidence at the rows that are not among these."""
        others, scores = search.sample(query)
        apart = ~torch.isin(others, rows)
        if not apart.any():
            return 0.0 if len(rows) == self._length else 1.0
        return float(evidence(scores[apart], self.motion, spread).mean())

    def _sequence(self, rows: Tensor) -> Tensor:
        return torch.searchsorted(self._starts, rows, right=True)


def _judged(track: Track, search: Search, part: range, ahead: int) -> Iterator[tuple[int, State]]:
    """Each query of a sequence in the light of so many later ones."""
    kept: list[State] = []
    for query in part:
        kept.append(track.step(kept[-1] if kept else None, search, query)[0])
        if len(kept) > ahead:
            yield query - ahead, _smoothed(track, kept[-ahead - 1 :])[0]
    first = max(0, len(part) - ahead)
    yield from zip(part[first:], _smoothed(track, kept[first:]), strict=True)


def _smoothed(track: Track, states: Sequence[State]) -> list[State]:
    """States of queries that follow one another, each in the light of those after it."""
    found: list[State] = []
    future: Future | None = None
    for number in reversed(range(len(states))):
        state = states[number]
        if future is None:
            future = Future(torch.ones_like(state.mapped), 1.0, 1.0)
        else:
            future = track.before(state, states[number + 1], future)
        mapped = state.mapped * future.mapped
        elsewhere, unmapped = state.elsewhere * future.elsewhere, state.unmapped * future.unmapped
        total = float(mapped.sum()) + elsewhere + unmapped
        mapped, elsewhere, unmapped = mapped / total, elsewhere / total, unmapped / total
        found.append(state._replace(mapped=mapped, elsewhere=elsewhere, unmapped=unmapped))
    return found[::-1]
