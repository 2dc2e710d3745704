"""Deciding: by the native core, or where it is not built by the oracle in NumPy, slowly.

Both give the same decisions; see `native.decide` and `reference`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from torch import Tensor

from .. import native
from ..native import decide as by_core
from ..native.decide import Decision, Scores, Search
from . import reference
from .sequences import runs

Evidence = Scores | Search


def decide(
    evidence: Evidence,
    queries: range,
    sequences: Sequence[str],
    mode: str | None,
    delay: int,
    top: int,
) -> Decision:
    """The decision about the queries of one drive, see `native.decide.decide`; ``sequences`` are
    those of the rows of the map, which stand together and in order if the drive is followed."""
    if not has_core():
        scores = _whole(evidence, queries, len(sequences))
        matching = [_matching(evidence, *each) for each in zip(queries, scores, strict=True)]
        return reference.decide(scores, sequences, mode, delay, top, matching)
    starts = _starts(sequences) if mode else [0][: len(sequences)]
    given = mode, delay, top, queries
    return by_core.decide(_array(evidence), starts, len(sequences), *given)


def has_core() -> bool:
    """Whether the native core compares and decides; says once why not."""
    return native.if_built("decides") is not None


def _starts(sequences: Sequence[str]) -> list[int]:
    return [part.start for part in runs(sequences)]


def _array(evidence: Evidence) -> Evidence:
    """Scores in memory as an array."""
    return evidence.detach().numpy() if isinstance(evidence, Tensor) else evidence


def _whole(evidence: Evidence, queries: range, rows: int) -> npt.NDArray[Any]:
    """``(Q, R)`` scores of all rows."""
    every = np.arange(rows)
    scores = [
        evidence.scores(query, every) if isinstance(evidence, Search) else evidence[query]
        for query in queries
    ]
    return np.reshape([np.asarray(each) for each in scores], (len(queries), rows))


def _matching(evidence: Evidence, query: int, scores: npt.NDArray[Any]) -> int:
    """How many rows could match a query: those with a score, and of all as many as of a sample."""
    known = int(np.isfinite(scores).sum())
    if not isinstance(evidence, Search):
        return known
    sampled = np.isfinite(np.asarray(evidence.sample(query)[1]))
    return max(known, len(scores) * int(sampled.sum()) // max(1, len(sampled)))
