"""An index on disk, for databases that do not fit in memory.

It has inverted lists of descriptors quantised to one bit per number (RaBitQ, arXiv 2405.12497),
built and searched by Lance (IVF_RQ). Of the kinds of index in Lance it is the fastest to build and
the smallest, with the same recall: docs/scale.md.

Frames that the index finds are scored again with the stored descriptors: scores are exact, but a
candidate may be missed. Frames added after it was built are searched as well.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from ..database.reading import read_rows
from ..database.rows import intact, matrix
from ..recognition.matching import match

if TYPE_CHECKING:
    import pyarrow as pa
    from lance import LanceDataset
    from torch import Tensor

    from ..database.database import Database

ROWS_OF_A_LIST = 4096
LEAST_ROWS = 256
PROBES = 24
CANDIDATES = 100

_SAMPLE = 200
_ROUNDING = 1e-6
"""Cosines of equal frames may differ by this in float32."""

Candidates = list[tuple[str, float]]
"""Pairs of frame id and exact cosine, best first."""


class IndexReport(NamedTuple):
    """The number of inverted lists of an index, of which a query searches `PROBES`; the seconds to
    build it; for N of 1 and 10 the fraction of the exact N best matches that are among the N best
    by the index, over a sample of frames, none of which matches itself; and the median time of a
    query."""

    lists: int
    seconds: float
    recall_at: dict[int, float]
    milliseconds: float


def build_index(database: Database) -> IndexReport:
    """Builds the index of a database, replaces an earlier one, and compares it with exact search. A
    database that is damaged or has fewer than `LEAST_ROWS` frames is a ValueError, an index that
    cannot be written an OSError."""
    rows = len(database)
    if rows < LEAST_ROWS:
        raise ValueError(
            f"an index needs at least {LEAST_ROWS} frames to learn from, {database.path} holds "
            f"{rows}: search it without"
        )
    lists = max(1, rows // ROWS_OF_A_LIST)
    began = time.perf_counter()
    column = database.columns[0].name
    if database.width % 8:  # one bit per number would not fill whole bytes
        database.write_index(column, "IVF_FLAT", lists)
    else:
        database.write_index(column, "IVF_RQ", lists, num_bits=1)
    seconds = time.perf_counter() - began
    frames = list(database.known())
    sample = np.random.default_rng(0).choice(len(frames), min(_SAMPLE, len(frames)), replace=False)
    sample.sort()
    queries, exact = _exact(database.table(), column, sample)
    found, times = torch.full((len(queries), 10), -torch.inf), []
    for number, (query, row) in enumerate(zip(queries, sample, strict=True)):
        began = time.perf_counter()
        [candidates] = search_index(database, query[None], 11)
        times.append(time.perf_counter() - began)
        scores = [score for frame, score in candidates if frame != frames[row]][:10]
        found[number, : len(scores)] = torch.tensor(scores)
    recall = {}
    for n in (1, 10):  # frames with the same score count alike
        is_match = exact[:, :n] > -torch.inf
        least = exact[:, :n].masked_fill(~is_match, torch.inf).amin(1, keepdim=True) - _ROUNDING
        recall[n] = float((found[:, :n] >= least).sum() / is_match.sum().clamp(min=1))
    return IndexReport(lists, seconds, recall, 1000 * float(np.median(times)))


def _exact(table: LanceDataset, column: str, rows: npt.NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Descriptors of rows, and the scores of their 10 best matches except the row itself."""
    stored = table.take(rows.tolist(), columns=[column])[column]
    queries = torch.from_numpy(matrix(stored).copy())
    scores, first = torch.full((len(rows), 10), -torch.inf), 0
    for batch in read_rows(table):
        itself = torch.from_numpy(rows[:, None] - first == np.arange(len(batch)))
        found = match(queries, matrix(batch[column]).copy(), 10, excluded=itself)
        scores = torch.cat([scores, found.scores], 1).topk(10).values
        first += len(batch)
    return queries, scores


def search_index(
    database: Database, queries: Tensor, top: int = 5, sequences: Collection[str] | None = None
) -> list[Candidates]:
    """The ``top`` best matches of queries ``(Q, D)`` float among the frames of some sequences, by
    default all, of a database, by its index. No index, or a damaged row, is a ValueError."""
    table, condition = require_index(database), condition_of(sequences)
    column = database.columns[0].name
    candidates: list[Candidates] = []
    for query in queries:
        if not query.any():
            candidates.append([])
            continue
        names = table.schema.names
        found = nearest(table, column, query, max(CANDIDATES, 4 * top), condition, names)
        if not intact(found.select(names)).all():
            raise ValueError(f"{table.uri} is damaged; ssrvlad db verify shows where")
        best = match(query[None], matrix(found[column]).copy(), top)
        frames = found["frame"].to_pylist()
        pairs = zip(best.indices[0].tolist(), best.scores[0].tolist(), strict=True)
        candidates.append([(frames[row], score) for row, score in pairs if row >= 0])
    return candidates


def require_index(database: Database) -> LanceDataset:
    """The table of a database; raises ValueError if it has no index."""
    table, column = database.table(), database.columns[0].name
    if not any(column in index.field_names for index in table.describe_indices()):
        raise ValueError(f"{database.path} has no index; ssrvlad db index builds one")
    return table


def nearest(
    table: LanceDataset,
    column: str,
    query: Tensor,
    count: int,
    condition: str | None,
    columns: list[str],
) -> pa.Table:
    """Columns of the rows whose descriptors in a column are nearest to a ``(D,)`` query, and that
    fulfil an SQL condition, if any."""
    return table.to_table(
        columns=columns,
        nearest={"column": column, "q": query.float().numpy(), "k": count, "nprobes": PROBES},
        filter=condition,
        prefilter=condition is not None,
        with_row_id=True,
        disable_scoring_autoprojection=True,
    )


def condition_of(sequences: Collection[str] | None) -> str | None:
    """The rows of some sequences as a condition in SQL; ``None`` for all."""
    if sequences is None:
        return None
    quoted = ("'" + name.replace("'", "''") + "'" for name in sequences)
    return f"sequence IN ({', '.join(quoted)})"
