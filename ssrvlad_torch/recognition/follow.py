"""Follow: places of whole sequences, by a hidden Markov model over the frames of the map.

One frame is often ambiguous, a sequence of frames seldom. The hidden state is the row of the map
where the camera is, and its speed in rows a frame (see `motion.SPEEDS`). The speed seldom changes,
and the camera seldom jumps. One more state is a place that the map lacks. Not in the paper.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from . import deciding
from .display import candidates_table
from .matching import checked_number
from .motion import BACKWARDS, FORWARDS, Motion
from .sequences import runs

Mode = Literal["online", "offline"]


class Places(NamedTuple):
    """Where each query is.

    Attributes:
        scores: ``(Q, top)`` float32, probabilities of the candidates, falling; -inf for none.
        indices: ``(Q, top)`` int64, rows of the map; -1 for none.
        near: ``(Q,)`` float32, the probability of the rows within `motion.NEAR` of the first
            candidate.
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
    linear in the map; memory holds ``2 * sqrt(Q)`` beliefs of 7 numbers a row.

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
            `reference.course`.

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
    found = [
        deciding.follow(
            scores, part, reference_sequences, motion or Motion(), way, mode, delay, top
        )
        for part in runs(drives)
    ]
    scored, single = torch.zeros(0, top), torch.zeros(0)
    none = Places(scored, scored.long(), single, single, single.double())
    parts = [none, *(Places(*map(torch.as_tensor, each)) for each in found)]
    return Places(*map(torch.cat, zip(*parts, strict=True)))


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
