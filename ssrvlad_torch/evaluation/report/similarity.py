"""The similarity matrix reduced to a bounded size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..outcomes import Bools, Outcomes, Rows, Truth
from .contents import Scores

MOST_ROWS, MOST_COLUMNS = 400, 800
_QUERY_BLOCK, _REFERENCE_BLOCK = 1 << 10, 1 << 12


@dataclass(frozen=True)
class SimilarityMatrix:
    """A matrix of queries by references, reduced to ``h`` by ``w`` cells.

    Attributes:
        scores: ``(h, w)`` float32, the highest score of each cell, -inf if no pair can match.
        truth: ``(h, w)`` bool, cells with a true match.
        right, wrong: ``(h, w)`` bool, cells with a right, and with a wrong best candidate.
        rows, columns: ``(h + 1,)`` and ``(w + 1,)`` int64, the first query and the first reference
            of each cell, then the number of queries and of references.
    """

    scores: npt.NDArray[np.float32]
    truth: Bools
    right: Bools
    wrong: Bools
    rows: Rows
    columns: Rows


def similarity_matrix(
    scores: Scores,
    references: int,
    outcomes: Outcomes,
    truth: Truth,
    most: tuple[int, int] = (MOST_ROWS, MOST_COLUMNS),
) -> SimilarityMatrix:
    """Reduces the scores of all pairs with ``references`` references to at most ``most`` rows and
    columns of cells, block by block."""
    rows, columns = _edges(len(outcomes), most[0]), _edges(references, most[1])
    cells = np.full((len(rows) - 1, len(columns) - 1), -np.inf, np.float32)
    for across in _blocks(columns, _REFERENCE_BLOCK):
        for down in _blocks(rows, _QUERY_BLOCK):
            cells[down, across] = _reduced(scores, rows, down, columns, across)
    query = np.arange(len(outcomes))
    right, wrong = (
        _marked(rows, columns, query[chosen], outcomes.candidate[chosen])
        for chosen in (outcomes.correct, ~outcomes.correct & (outcomes.candidate >= 0))
    )
    counts = [len(matches) for matches in truth]
    true = np.concatenate((np.zeros(0, np.int64), *truth))
    marked = _marked(rows, columns, np.repeat(query, counts), true)
    return SimilarityMatrix(cells, marked, right, wrong, rows, columns)


def _edges(frames: int, most: int) -> Rows:
    return np.linspace(0, frames, min(frames, most) + 1).astype(np.int64)


def _blocks(edges: Rows, frames: int) -> list[slice]:
    """Slices of cells with at most ``frames`` frames each, or of one cell."""
    cells, blocks, start = len(edges) - 1, [], 0
    while start < cells:
        reach = int(np.searchsorted(edges, edges[start] + frames, side="right")) - 1
        stop = max(start + 1, min(reach, cells))
        blocks.append(slice(start, stop))
        start = stop
    return blocks


def _reduced(
    scores: Scores, rows: Rows, down: slice, columns: Rows, across: slice
) -> npt.NDArray[np.float32]:
    """The highest score of each cell of a block."""
    queries = np.arange(rows[down.start], rows[down.stop])
    references = np.arange(columns[across.start], columns[across.stop])
    pairs = scores(queries, references).astype(np.float32, copy=False)
    lines = np.maximum.reduceat(pairs, rows[down] - queries[0], axis=0)
    return np.asarray(np.maximum.reduceat(lines, columns[across] - references[0], axis=1))


def _marked(rows: Rows, columns: Rows, queries: Rows, references: Rows) -> Bools:
    """The cells of the pairs of the n-th query and the n-th reference."""
    marked = np.zeros((len(rows) - 1, len(columns) - 1), bool)
    marked[_cell(rows, queries), _cell(columns, references)] = True
    return marked


def _cell(edges: Rows, frames: Rows) -> Rows:
    return np.searchsorted(edges, frames, side="right") - 1
