"""Follow: places of whole sequences, by a hidden Markov model over the frames of the map.

One frame is often ambiguous, a sequence of them seldom. The hidden state is the row of the map at
which the camera is, and how fast it moves along it (see `motion.SPEEDS`): it advances by so many
rows as its speed says, give or take one, seldom changes speed, and now and then jumps anywhere.
One more state is a place that the map does not have. Not in the paper.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from .display import candidates_table
from .filter import Belief, Filter, Future
from .matching import best_of
from .motion import Motion

NEAR = 3
"""Rows on each side of a row that show the same place."""

Mode = Literal["online", "offline"]


class Places(NamedTuple):
    """Where each query is.

    Attributes:
        scores: ``(Q, top)`` float32, probabilities of the candidates, falling; -inf for none.
        indices: ``(Q, top)`` int64, rows of the map; -1 for none.
        near: ``(Q,)`` float32, the probability to be within `NEAR` rows of the first candidate.
        unmapped: ``(Q,)`` float32, the probability of a place that the map lacks.
    """

    scores: Tensor
    indices: Tensor
    near: Tensor
    unmapped: Tensor

    def _repr_html_(self) -> str:
        return candidates_table(self.scores, self.indices, near=self.near, unmapped=self.unmapped)


class Scores(Protocol):
    """``scores[i]``: the ``(R,)`` float scores of query ``i``. A matrix, or what computes it."""

    def __len__(self) -> int: ...

    def __getitem__(self, query: int, /) -> Tensor: ...


@torch.no_grad()
def follow(
    scores: Tensor | Scores,
    sequences: Sequence[str],
    queries: Sequence[str] | None = None,
    mode: Mode = "offline",
    delay: int = 0,
    top: int = 5,
    motion: Motion | None = None,
) -> Places:
    """Where the queries are, each in the light of its sequence.

    Online a query is judged by those before it, itself and ``delay`` after it (forward
    algorithm); offline by its whole sequence (forward-backward). Time is linear in the map for
    each query; memory holds ``2 * sqrt(Q)`` beliefs of 8 numbers a row.

    Args:
        scores: ``(Q, R)`` cosines, see `score` and `sweep`; -inf for an empty reference and
            whatever else is no candidate. Of an empty query all are, and it is placed by its
            neighbours alone.
        sequences: the sequence of each row; the rows of one stand together and in order.
        queries: the sequence of each query likewise; without, all are one.
        mode: ``"online"`` or ``"offline"``.
        delay: queries for which an online answer waits.
        top: candidates of each query.
        motion: what sequences do.

    Raises:
        ValueError: the scores do not fit the sequences, are NaN or above 1; the frames of a
            sequence do not stand together; or a setting is outside its range.

    Example:
        >>> scores = torch.eye(30)[10:20]
        >>> follow(scores, ["drive"] * 30).indices[:, 0].tolist()
        [10, 11, 12, 13, 14, 15, 16, 17, 18, 19]
    """
    if mode not in ("online", "offline"):
        raise ValueError(f"mode: expected online or offline, got {mode!r}")
    if delay < 0 or top < 1:
        raise ValueError(f"expected a delay from 0 and a top from 1, got {delay} and {top}")
    drives = [""] * len(scores) if queries is None else queries
    if len(drives) != len(scores):
        raise ValueError(
            f"expected a sequence for each of {len(scores)} queries, got {len(drives)}"
        )
    track = Filter(sequences, motion)
    parts = list(runs(sequences))
    found: dict[int, Places] = {}
    for part in runs(drives):
        offline = mode == "offline"
        beliefs = _offline(track, scores, part) if offline else _online(track, scores, part, delay)
        for query, belief in beliefs:
            found[query] = _places(track.rows(belief), belief.unmapped, top, scores[query], parts)
    return stacked([found[query] for query in range(len(drives))], top)


def runs(sequences: Sequence[str]) -> Iterator[range]:
    """The rows of each sequence.

    Raises:
        ValueError: those of one do not stand together.
    """
    first, seen = 0, set[str]()
    for sequence, same in itertools.groupby(sequences):
        if sequence in seen:
            raise ValueError(f"expected the frames of {sequence!r} together, got some at {first}")
        seen.add(sequence)
        last = first + len(list(same))
        yield range(first, last)
        first = last


def stacked(found: Sequence[Places], top: int) -> Places:
    """The places of all queries, from those of each."""
    if not found:
        none = torch.zeros(0)
        return Places(none.view(0, top), none.view(0, top).long(), none, none)
    return Places(*(torch.stack(values) for values in zip(*found, strict=True)))


def _places(
    rows: Tensor, unmapped: float, top: int, scores: Tensor, sequences: Sequence[range]
) -> Places:
    """Candidates by falling probability, the first of equals first.

    They are among the rows that have a score. An empty query has none, and any row may be its
    place.
    """
    scored = scores > -torch.inf
    some = 0 < int(scored.sum()) < len(rows)
    best = best_of(rows.masked_fill(~scored, -torch.inf) if some else rows, top)
    near, row = torch.tensor(0.0), int(best.indices[0])
    if row >= 0:
        own = sequences[bisect_right(sequences, row, key=lambda part: part.start) - 1]
        near = rows[max(row - NEAR, own.start) : min(row + NEAR + 1, own.stop)].sum()
    return Places(*best, near, torch.tensor(unmapped))


def _online(
    track: Filter, scores: Tensor | Scores, part: range, delay: int
) -> Iterator[tuple[int, Belief]]:
    """Beliefs of one sequence of queries, each in the light of ``delay`` later ones."""
    track.restart()
    kept: list[tuple[int, Belief, Tensor]] = []
    for query in part:
        told = scores[query]
        track.step(told)
        if not delay:
            yield query, track.belief
            continue
        kept.append((query, track.belief, track.evidence(told)))
        if len(kept) > delay:
            yield kept[0][0], _looking_back(track, kept)
            kept.pop(0)
    while kept:
        yield kept[0][0], _looking_back(track, kept)
        kept.pop(0)


def _looking_back(track: Filter, kept: Sequence[tuple[int, Belief, Tensor]]) -> Belief:
    """The first belief in the light of the later frames' evidence."""
    future = track.no_future()
    for _, _, told in reversed(kept[1:]):
        future = track.before(told, future)
    return _smoothed(kept[0][1], future)


def _offline(track: Filter, scores: Tensor | Scores, part: range) -> Iterator[tuple[int, Belief]]:
    """Beliefs of one sequence of queries in the light of all of it, the last first.

    Of the forward pass one belief in ``sqrt(Q)`` is kept; the others are computed again.
    """
    track.restart()
    stride = max(1, math.isqrt(len(part)))
    kept: dict[int, Belief] = {}
    for query in part:
        track.step(scores[query])
        if (query - part.start) % stride == 0:
            kept[query] = track.belief
    future = track.no_future()
    for start in reversed(range(part.start, part.stop, stride)):
        stretch = range(start, min(start + stride, part.stop))
        told = {query: track.evidence(scores[query]) for query in stretch}
        forward = [kept.pop(start)]
        for query in stretch[1:]:
            forward.append(track.after(forward[-1], told[query])[0])
        for query in reversed(stretch):
            yield query, _smoothed(forward.pop(), future)
            future = track.before(told[query], future)


def _smoothed(belief: Belief, future: Future) -> Belief:
    mapped, unmapped = belief.mapped * future.mapped, belief.unmapped * future.unmapped
    cells = mapped.sum(0)
    total = float(cells.sum()) + unmapped
    return Belief(mapped.div_(total), cells.div_(total), unmapped / total)
