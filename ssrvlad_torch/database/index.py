"""An index on disk, for databases that do not fit in memory: inverted lists of descriptors
quantised to a bit a number (RaBitQ, arXiv 2405.12497), made and searched by Lance (IVF_RQ). Of the
kinds of index that Lance has it is the quickest to build and the smallest, and finds as much:
docs/scale.md.

What the index finds is scored again with the stored descriptors, so that scores are exact and only
a candidate that it passes over is lost. Frames that were added since it was built are searched too.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from ..recognition.matching import match
from .reading import read_rows
from .rows import DESCRIPTOR, intact, matrix

if TYPE_CHECKING:
    import pyarrow as pa
    from lance import LanceDataset
    from torch import Tensor

    from .database import Database

ROWS_OF_A_LIST = 4096
LEAST_ROWS = 256
PROBES = 24
CANDIDATES = 100

_SAMPLE = 200
_ROUNDING = 1e-6
"""Of cosines in float32, by which equal frames may differ."""

Candidates = list[tuple[str, float]]
"""Ids and exact cosines, best first."""


class IndexReport(NamedTuple):
    """What an index is worth.

    Attributes:
        lists: number of inverted lists, of which `PROBES` are looked through for a query.
        seconds: how long it took to build.
        recall_at: for N of 1 and 10, the fraction of the exact N best matches of a sample of
            frames, the frame itself aside, that are among the N best by the index.
        milliseconds: of a query by the index, the median of the sample.
    """

    lists: int
    seconds: float
    recall_at: dict[int, float]
    milliseconds: float


def build_index(database: Database) -> IndexReport:
    """Builds the index of a database, or builds it anew, and compares it with exact search.

    Raises:
        ValueError: there are too few frames to learn from, or the database is damaged.
        OSError: the index cannot be written.
    """
    rows = len(database)
    if rows < LEAST_ROWS:
        raise ValueError(
            f"an index needs at least {LEAST_ROWS} frames to learn from, {database.path} holds "
            f"{rows}: search it without"
        )
    lists = max(1, rows // ROWS_OF_A_LIST)
    began = time.perf_counter()
    if database.width % 8:  # no whole bytes of bits
        database.write_index(DESCRIPTOR, "IVF_FLAT", lists)
    else:
        database.write_index(DESCRIPTOR, "IVF_RQ", lists, num_bits=1)
    seconds = time.perf_counter() - began
    recall, milliseconds = _compare(database)
    return IndexReport(lists, seconds, recall, milliseconds)


def search_index(
    database: Database,
    queries: Tensor,
    top: int = 5,
    sequences: Collection[str] | None = None,
) -> list[Candidates]:
    """The best matches of queries among the frames of a database, by its index.

    Args:
        database: has an index.
        queries: ``(Q, D)`` float.
        top: number of candidates.
        sequences: the only ones that candidates may be of; without, all.

    Raises:
        ValueError: there is no index, or a row that was found is damaged.
    """
    table, condition = indexed(database), filter_of(sequences)
    return [_search(table, query, top, condition) for query in queries]


def indexed(database: Database) -> LanceDataset:
    """The table of a database that has an index.

    Raises:
        ValueError: it has none.
    """
    table = database.table()
    if not any(DESCRIPTOR in index.field_names for index in table.describe_indices()):
        raise ValueError(f"{database.path} has no index; ssrvlad db index builds one")
    return table


def nearest(
    table: LanceDataset, query: Tensor, count: int, condition: str | None, columns: list[str]
) -> pa.Table:
    """Columns of the rows nearest to ``(D,)`` a query by the index, and their row ids.

    Args:
        condition: the rows that may be found, in SQL; without, all.
    """
    return table.to_table(
        columns=columns,
        nearest={
            "column": DESCRIPTOR,
            "q": query.float().numpy(),
            "k": count,
            "nprobes": PROBES,
        },
        filter=condition,
        prefilter=condition is not None,
        with_row_id=True,
        disable_scoring_autoprojection=True,
    )


def _search(table: LanceDataset, query: Tensor, top: int, condition: str | None) -> Candidates:
    if not bool(query.any()):
        return []
    found = nearest(table, query, max(CANDIDATES, 4 * top), condition, table.schema.names)
    if not intact(found.select(table.schema.names)).all():
        raise ValueError(f"{table.uri} is damaged; ssrvlad db verify tells where")
    best = match(query[None], matrix(found[DESCRIPTOR]).copy(), top)
    frames = found["frame"].to_pylist()
    pairs = zip(best.indices[0].tolist(), best.scores[0].tolist(), strict=True)
    return [(frames[row], score) for row, score in pairs if row >= 0]


def filter_of(sequences: Collection[str] | None) -> str | None:
    """What Lance filters by, in SQL."""
    if sequences is None:
        return None
    quoted = ("'" + name.replace("'", "''") + "'" for name in sequences)
    return f"sequence IN ({', '.join(quoted)})"


def _compare(database: Database) -> tuple[dict[int, float], float]:
    """Recall against exact search, and the median time of a query in milliseconds."""
    frames = list(database.known())
    chosen = np.random.default_rng(0).choice(len(frames), min(_SAMPLE, len(frames)), replace=False)
    queries, exact = _exact(database, np.sort(chosen))
    found, times = torch.full((len(queries), 10), -torch.inf), []
    for place, (query, row) in enumerate(zip(queries, np.sort(chosen), strict=True)):
        began = time.perf_counter()
        [candidates] = search_index(database, query[None], 11)
        times.append(time.perf_counter() - began)
        scores = [score for frame, score in candidates if frame != frames[row]][:10]
        found[place, : len(scores)] = torch.tensor(scores)
    return {n: _recall(exact[:, :n], found[:, :n]) for n in (1, 10)}, 1000 * float(np.median(times))


def _recall(exact: Tensor, found: Tensor) -> float:
    """The part of the best ``(Q, n)`` scores that was found; frames of one score are as good."""
    there = exact > -torch.inf
    least = exact.masked_fill(~there, torch.inf).amin(1, keepdim=True) - _ROUNDING
    return float((found >= least).sum() / there.sum().clamp(min=1))


def _exact(database: Database, rows: npt.NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Some rows, and the scores of their 10 best matches but themselves, read batch by batch."""
    table = database.table()
    queries = torch.from_numpy(
        matrix(table.take(rows.tolist(), columns=[DESCRIPTOR])[DESCRIPTOR]).copy()
    )
    scores = torch.full((len(rows), 10), -torch.inf)
    first = 0
    for batch in read_rows(table):
        own = np.clip(np.stack([rows, rows + 1], axis=1) - first, 0, len(batch))
        found = match(queries, matrix(batch[DESCRIPTOR]).copy(), 10, exclude=own)
        scores = torch.cat([scores, found.scores], 1).topk(10).values
        first += len(batch)
    return queries, scores
