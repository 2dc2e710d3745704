"""Follow: places of whole sequences, by a hidden Markov model over the frames of the map.

One frame is often ambiguous, a sequence of frames seldom. The hidden state is the row of the map
where the camera is, and its speed in rows a frame (see `motion.SPEEDS`). The speed seldom changes,
and the camera seldom jumps. One more state is a place that the map lacks. Not in the paper.
"""

import itertools
import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from .display import candidates_table
from .filter import Belief, Filter, Future
from .matching import Matches, best_of, checked_number
from .motion import BACKWARDS, FORWARDS, Motion
from .rivals import chance_of

NEAR = 3
"""Rows on each side of a row that show the same place."""

Mode = Literal["online", "offline"]
Item = TypeVar("Item")


class Places(NamedTuple):
    """Where each query is.

    Attributes:
        scores: ``(Q, top)`` float32, probabilities of the candidates, falling; -inf for none.
        indices: ``(Q, top)`` int64, rows of the map; -1 for none.
        near: ``(Q,)`` float32, the probability of the rows within `NEAR` of the first candidate.
        unmapped: ``(Q,)`` float32, the probability of a place that the map lacks.
        chance: ``(Q,)`` float64, how the probability of the first candidate compares with those of
            the best rows elsewhere, see `rivals.Chance`.
    """

    scores: Tensor
    indices: Tensor
    near: Tensor
    unmapped: Tensor
    chance: Tensor

    def _repr_html_(self) -> str:
        columns = {name: getattr(self, name) for name in ("near", "unmapped", "chance")}
        return candidates_table(self.scores, self.indices, **columns)


class Scores(Protocol):
    """A ``(Q, R)`` matrix of scores, or an object that computes its rows: ``scores[i]`` is the
    ``(R,)`` float scores of query ``i``."""

    def __len__(self) -> int: ...

    def __getitem__(self, query: int, /) -> Tensor: ...


@torch.no_grad()
def follow(
    scores: Tensor | Scores,
    reference_sequences: Sequence[str],
    query_sequences: Sequence[str] | None = None,
    mode: Mode = "offline",
    delay: int = 0,
    top: int = 5,
    motion: Motion | None = None,
    way: int = FORWARDS,
) -> Places:
    """The place of each query, given the other queries of its sequence.

    Online, a query is placed by itself, the queries before it and ``delay`` queries after it
    (forward algorithm); offline, by its whole sequence (forward-backward). Time for each query is
    linear in the map; memory holds ``2 * sqrt(Q)`` beliefs of 14 numbers a row.

    Args:
        scores: ``(Q, R)`` cosines, see `score` and `sweep`; -inf for an empty reference and for
            all else that is no candidate. All scores of an empty query are -inf; its neighbours
            alone place it.
        reference_sequences: the sequence of each row; the rows of one stand together and in order.
        query_sequences: the same of each query. Without, all are of one sequence.
        mode: ``"online"`` or ``"offline"``.
        delay: number of later queries that an online answer waits for.
        top: number of candidates of each query.
        motion: how sequences move.
        way: in which the queries run the map, `motion.FORWARDS` or `motion.BACKWARDS`, see
            `courses`.

    Raises:
        ValueError: the scores do not fit the sequences, are NaN or above 1; the frames of a
            sequence do not stand together; or a setting is outside its range.

    Examples:
        >>> scores = torch.eye(30)[10:20]
        >>> follow(scores, ["drive"] * 30).indices[:, 0].tolist()
        [10, 11, 12, 13, 14, 15, 16, 17, 18, 19]
    """
    if mode not in ("online", "offline"):
        raise ValueError(f"mode: expected online or offline, got {mode!r}")
    if way not in (FORWARDS, BACKWARDS):
        raise ValueError(f"way: expected {FORWARDS} or {BACKWARDS}, got {way!r}")
    scores = torch.from_numpy(scores) if isinstance(scores, np.ndarray) else scores
    delay, top = checked_number("delay", delay, least=0), checked_number("top", top, least=1)
    drives = [""] * len(scores) if query_sequences is None else query_sequences
    if len(drives) != len(scores):
        raise ValueError(
            f"expected a sequence for each of {len(scores)} queries, got {len(drives)}"
        )
    track = Filter(reference_sequences, motion, [way])
    parts = list(runs(reference_sequences))
    places: dict[int, Places] = {}
    for part in runs(drives):
        offline = mode == "offline"
        beliefs = _offline(track, scores, part) if offline else _online(track, scores, part, delay)
        for query, belief in beliefs:
            rows = track.rows(belief)
            best = ranked(rows, scores[query], top)
            near, row = torch.tensor(0.0), int(best.indices[0])
            if row >= 0:
                own = parts[bisect_right(parts, row, key=lambda part: part.start) - 1]
                near = rows[max(row - NEAR, own.start) : min(row + NEAR + 1, own.stop)].sum()
            unmapped = torch.tensor(belief.unmapped)
            places[query] = Places(*best, near, unmapped, compared(rows, scores[query]))
    return stacked([places[query] for query in range(len(drives))], top)


@torch.no_grad()
def gain(
    scores: Tensor | Scores,
    sequences: Sequence[str],
    motion: Motion,
    way: int,
    queries: Sequence[int],
) -> float:
    """How much likelier queries are as a sequence that runs the map in a way than each alone, see
    `Filter.gain`."""
    track = Filter(sequences, motion, [way])
    for query in queries:
        track.step(scores[query])
    return track.gain


def runs(sequences: Sequence[str]) -> Iterator[range]:
    """Rows of each sequence; rows of one that do not stand together are a ValueError."""
    first, names = 0, set[str]()
    for sequence, rows in itertools.groupby(sequences):
        if sequence in names:
            raise ValueError(f"expected the frames of {sequence!r} together, got some at {first}")
        names.add(sequence)
        last = first + len(list(rows))
        yield range(first, last)
        first = last


def stacked(places: Sequence[Places], top: int) -> Places:
    """The places of all queries, from those of each."""
    if not places:
        none = torch.zeros(0)
        matches = none.view(0, top), none.view(0, top).long()
        return Places(*matches, none, none, none.double())
    return Places(*(torch.stack(values) for values in zip(*places, strict=True)))


def ranked(beliefs: Tensor, scores: Tensor, top: int, rows: Tensor | None = None) -> Matches:
    """Candidates of one query by falling belief ``(N,)``, see `best_of`. Rows whose score is -inf
    are no candidates, unless all scores are: any row may be the place of an empty query."""
    scored = scores > -torch.inf
    if 0 < int(scored.sum()) < len(scored):
        beliefs = beliefs.masked_fill(~scored, -torch.inf)
    return best_of(beliefs, top, rows)


def compared(
    beliefs: Tensor, scores: Tensor, rows: Tensor | None = None, count: int | None = None
) -> Tensor:
    """`Places.chance` of one query, by beliefs ``(N,)`` in rows; rows whose score is -inf are no
    candidates. For the other arguments see `rivals.chance_of`."""
    values = beliefs.clamp(min=_LEAST_BELIEF).log().masked_fill(scores == -torch.inf, -torch.inf)
    return torch.tensor(chance_of(values, rows, count).chance, dtype=torch.double)


_LEAST_BELIEF = 1e-38


def windows(items: Iterable[Item], delay: int) -> Iterator[Sequence[Item]]:
    """Each item with the ``delay`` items after it, or fewer at the end."""
    held = deque[Item]()
    for item in items:
        held.append(item)
        if len(held) > delay:
            yield tuple(held)
            held.popleft()
    while held:
        yield tuple(held)
        held.popleft()


def _forward(
    track: Filter, scores: Tensor | Scores, part: range
) -> Iterator[tuple[int, Belief, Tensor]]:
    """Each query of one sequence, with the belief after it and its likelihood."""
    track.restart()
    for query in part:
        likelihood = track.likelihood(scores[query])
        track.update(likelihood)
        yield query, track.belief, likelihood


def _online(
    track: Filter, scores: Tensor | Scores, part: range, delay: int
) -> Iterator[tuple[int, Belief]]:
    """Beliefs of one sequence of queries, given ``delay`` later queries."""
    for (query, belief, _), *later in windows(_forward(track, scores, part), delay):
        future = track.no_future()
        for _, _, likelihood in reversed(later):
            future = track.before(likelihood, future)
        yield query, _smoothed(belief, future) if delay else belief


def _offline(track: Filter, scores: Tensor | Scores, part: range) -> Iterator[tuple[int, Belief]]:
    """Beliefs of one sequence of queries, given all of them, the last first.

    The forward pass stores one belief in ``sqrt(Q)``; the others are computed again.
    """
    stride = max(1, math.isqrt(len(part)))
    stored = {
        query: belief
        for query, belief, _ in _forward(track, scores, part)
        if (query - part.start) % stride == 0
    }
    future = track.no_future()
    for start in reversed(range(part.start, part.stop, stride)):
        stretch = range(start, min(start + stride, part.stop))
        likelihoods = {query: track.likelihood(scores[query]) for query in stretch}
        beliefs = [stored.pop(start)]
        for query in stretch[1:]:
            beliefs.append(track.after(beliefs[-1], likelihoods[query])[0])
        for query in reversed(stretch):
            yield query, _smoothed(beliefs.pop(), future)
            future = track.before(likelihoods[query], future)


def _smoothed(belief: Belief, future: Future) -> Belief:
    """A belief, given the later queries."""
    mapped, unmapped = belief.mapped * future.mapped, belief.unmapped * future.unmapped
    cells = mapped.sum(1)
    by_way = cells.sum(1).tolist()
    total = sum(by_way) + unmapped
    decoys = sum(by_way[1:]) / total
    return Belief(mapped.div_(total), cells[0].div_(total), decoys, unmapped / total)


IN_MEMORY = 1 << 26
"""Scores that are in memory at once."""


class Computed(Scores):
    """The scores of each query by a function."""

    def __init__(self, compute: Callable[[int], Tensor], queries: int) -> None:
        self._compute, self._queries = compute, queries

    def __len__(self) -> int:
        return self._queries

    def __getitem__(self, query: int, /) -> Tensor:
        return self._compute(query)


def in_blocks(
    compute: Callable[[slice], Tensor],
    queries: int,
    references: int,
    anchors: int,
    excluded: Tensor | None,
) -> Computed:
    """Scores of one sequence of queries, computed in blocks of queries that fit in memory."""
    fits = anchors * queries * references <= IN_MEMORY
    size = queries if fits else max(1, IN_MEMORY // (4 * anchors * max(1, references)))

    @lru_cache(maxsize=1)
    def block(number: int) -> Tensor:
        part = slice(number * size, (number + 1) * size)
        scores = compute(part)
        return scores if excluded is None else scores.masked_fill_(excluded[part], -torch.inf)

    return Computed(lambda query: block(query // size)[query % size], queries)
