"""An index on disk, for databases that do not fit in memory: inverted lists of descriptors
quantised to a bit a number (RaBitQ, arXiv 2405.12497), made and searched by Lance (IVF_RQ). Of the
kinds of index that Lance has it is the quickest to build and the smallest, and finds as much:
docs/scale.md.

What the index finds is scored again with the stored descriptors, so that scores are exact and only
a candidate that it passes over is lost. Frames that were added since it was built are searched too.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F

from ..recognition.matching import Rows, match
from ..recognition.motion import moments
from ..recognition.standardise import less, standardise
from ..recognition.sweep import score
from .reading import read_rows
from .rows import OF_A_RECORD, intact, matrix
from .selection import neighbours, select

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
_COLUMN = "descriptor"
_VERIFIED = [*OF_A_RECORD, "empty", _COLUMN, "checksum"]
_SAMPLE_ROWS = 1000
_ROWS_KEPT = 50_000
_ALONG = 8
_AHEAD, _THREADS = 8, 2

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
        database.write_index(_COLUMN, "IVF_FLAT", lists)
    else:
        database.write_index(_COLUMN, "IVF_RQ", lists, num_bits=1)
    seconds = time.perf_counter() - began
    recall, milliseconds = _compare(database)
    return IndexReport(lists, seconds, recall, milliseconds)


def search_index(
    database: Database,
    queries: Tensor,
    top: int = 5,
    threshold: float | None = None,
    sequences: Collection[str] | None = None,
    exclude: Sequence[Collection[str]] | None = None,
) -> list[Candidates]:
    """The best matches of queries among the frames of a database, by its index.

    Args:
        database: has an index.
        queries: ``(Q, D)`` float.
        top: number of candidates.
        threshold: candidates whose score is not above it are left out.
        sequences: the only ones that candidates may be of; without, all.
        exclude: for each query ids that are no candidates.

    Raises:
        ValueError: there is no index, or a row that was found is damaged.
    """
    table = _indexed(database)
    spared = exclude or [()] * len(queries)
    return [
        _search(table, query, top, threshold, _condition(sequences, ids))
        for query, ids in zip(queries, spared, strict=True)
    ]


class IndexSearch:
    """Candidates of queries by a database's index, for `recognition.candidates`.

    The index is of raw descriptors. With ``standardised`` it is asked for the rows nearest to each
    query less the mean of its sequence; what it finds, and every row that is scored, is scored with
    both means off: that of the query's sequence, and that of the row's, over all frames of the
    version that is read. Scores are those of exact search; only candidates may be lost.

    Args:
        database: has an index.
        queries: ``(Q, D)`` raw descriptors.
        query_sequences: the sequence of each.
        standardised: see above.
        allowed: sequences that candidates may be of; without, all.
        spared: ids of the queries, and how many frames on each side of a query in its own sequence
            are no candidates.

    Attributes:
        frames: of the database, in the order of its rows; without descriptors.

    Raises:
        ValueError: there is no index, a sequence is not there, or the database is damaged.
    """

    def __init__(
        self,
        database: Database,
        queries: Tensor,
        query_sequences: Sequence[str],
        standardised: bool = True,
        allowed: Collection[str] | None = None,
        spared: tuple[Sequence[str], int | None] = ((), None),
    ) -> None:
        self._table = _indexed(database)
        self.frames, self._places = database.placed()
        self._rows = np.argsort(self._places)
        ids = self._table.to_table(columns=[], with_row_id=True, scan_in_order=True)
        self._ids = ids["_rowid"].to_numpy()
        if allowed is not None:
            select(self.frames, allowed)
        names = list(dict.fromkeys(self.frames.sequences))
        number = {name: place for place, name in enumerate(names)}
        self._drives = np.array([number[name] for name in self.frames.sequences], np.int32)
        self._means = self._mean_of_each(len(names)) if standardised else None
        self._queries = standardise(queries, query_sequences) if standardised else queries
        self._allowed = None if allowed is None else [name in set(allowed) for name in names]
        self._condition = _condition(allowed, ())
        ids, reach = spared
        self._exclude = None if reach is None else neighbours(ids, self.frames, reach)
        self._columns = [_COLUMN] if standardised else _VERIFIED
        self._slots, self._kept = torch.full((len(self.frames),), -1), 0
        self._vectors = torch.empty(0, database.width)
        self._found: dict[int, Tensor] = {}
        self._samples: dict[int, Tensor] = {}
        self._pool = ThreadPoolExecutor(_THREADS)
        self._asked: dict[int, Future[pa.Table | None]] = {}
        rows = len(self.frames)
        few = np.random.default_rng(0).choice(rows, min(_SAMPLE_ROWS, rows), replace=False)
        self._sample = torch.from_numpy(np.sort(few))
        self._sampled = Rows.of(self._read(self._sample))

    def __len__(self) -> int:
        return len(self._queries)

    def candidates(self, query: int) -> Tensor:
        """See `recognition.candidates.Search`."""
        if query not in self._found:
            for later in range(query, min(query + _AHEAD, len(self))):
                if later not in self._asked and later not in self._found:
                    self._asked[later] = self._pool.submit(self._nearest, later)
            found = self._asked.pop(query).result()
            self._found[query] = self._rows_of(query, found)
        return self._found[query]

    def scores(self, query: int, rows: Tensor) -> Tensor:
        """See `recognition.candidates.Search`."""
        scores = score(self._queries[query][None], self._read(rows))[0]
        return scores.masked_fill(~self._may_match(query, rows), -torch.inf)

    def spread(self, query: int) -> tuple[float, float]:
        """See `recognition.candidates.Search`."""
        return moments(self.sample(query)[1])

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """See `recognition.candidates.Search`."""
        if query not in self._samples:
            self._samples[query] = score(self._queries[query][None], self._sampled)[0]
        return self._sample, self._samples[query]

    def _nearest(self, query: int) -> pa.Table | None:
        vector = self._queries[query]
        if not bool(vector.any()):
            return None
        return _nearest(self._table, vector, CANDIDATES, self._condition, self._columns)

    def _rows_of(self, query: int, found: pa.Table | None) -> Tensor:
        if found is None:
            return torch.zeros(0, dtype=torch.int64)
        places = np.searchsorted(self._ids, found["_rowid"].to_numpy())
        rows = torch.from_numpy(self._rows[places])
        self._keep(rows, found)
        return rows[self._may_match(query, rows)]

    def _may_match(self, query: int, rows: Tensor) -> Tensor:
        may = torch.ones(len(rows), dtype=torch.bool)
        if self._allowed is not None:
            may &= torch.tensor(self._allowed)[torch.from_numpy(self._drives[rows.numpy()])]
        if self._exclude is not None:
            first, last = self._exclude[query].tolist()
            may &= (rows < first) | (rows >= last)
        return may

    def _read(self, rows: Tensor) -> Tensor:
        """``(N, D)`` descriptors of rows, less their means if so; some rows around them are read
        along, for the steps to come."""
        missing = rows[self._slots[rows] < 0]
        if len(missing):
            if self._kept > _ROWS_KEPT:
                self._slots.fill_(-1)
                self._kept, missing = 0, rows
            around = missing[:, None] + torch.arange(-_ALONG, _ALONG + 1)
            near = torch.from_numpy(np.unique(around.numpy()))
            near = near[(near >= 0) & (near < len(self._slots))]
            near = near[self._slots[near] < 0]
            stored = self._table.take(self._places[near.numpy()].tolist(), columns=self._columns)
            self._keep(near, stored)
        return self._vectors[self._slots[rows]]

    def _keep(self, rows: Tensor, found: pa.Table) -> None:
        """Remembers what was read of rows."""
        if "checksum" in self._columns and not intact(found.select(_VERIFIED)).all():
            raise ValueError(f"{self._table.uri} is damaged; ssrvlad db verify tells where")
        vectors = torch.from_numpy(matrix(found[_COLUMN]).copy())
        fresh = (self._slots[rows] < 0).nonzero()[:, 0]
        rows, vectors = rows[fresh], vectors[fresh]
        if self._means is not None:
            drives = torch.from_numpy(self._drives[rows.numpy()])
            vectors = less(F.normalize(vectors, dim=1), self._means[drives.long()])
        last = self._kept + len(rows)
        if last > len(self._vectors):
            more = self._vectors.new_empty(max(last, 2 * len(self._vectors)), vectors.shape[1])
            more[: self._kept] = self._vectors[: self._kept]
            self._vectors = more
        self._vectors[self._kept : last] = vectors
        self._slots[rows] = torch.arange(self._kept, last)
        self._kept = last

    def _mean_of_each(self, count: int) -> Tensor:
        """``(count, D)`` float32, the mean of each sequence, in one pass over the rows."""
        totals = np.zeros((count, int(self._table.schema.field(_COLUMN).type.list_size)))
        counted, first = np.zeros(count), 0
        for batch in read_rows(self._table):
            vectors = F.normalize(torch.from_numpy(matrix(batch[_COLUMN]).copy()), dim=1).numpy()
            drives = self._drives[self._rows[first : first + len(batch)]]
            for drive in np.unique(drives):
                totals[drive] += vectors[drives == drive].sum(0, dtype=np.float64)
            np.add.at(counted, drives, vectors.any(axis=1))
            first += len(batch)
        return torch.from_numpy(totals / np.maximum(counted, 1)[:, None]).float()


def _indexed(database: Database) -> LanceDataset:
    table = database.table()
    if not any(_COLUMN in index.field_names for index in table.describe_indices()):
        raise ValueError(f"{database.path} has no index; ssrvlad db index builds one")
    return table


def _nearest(
    table: LanceDataset, query: Tensor, count: int, condition: str | None, columns: list[str]
) -> pa.Table:
    return table.to_table(
        columns=columns,
        nearest={
            "column": _COLUMN,
            "q": query.float().numpy(),
            "k": count,
            "nprobes": PROBES,
        },
        filter=condition,
        prefilter=condition is not None,
        with_row_id=True,
        disable_scoring_autoprojection=True,
    )


def _search(
    table: LanceDataset, query: Tensor, top: int, threshold: float | None, condition: str | None
) -> Candidates:
    if not bool(query.any()):
        return []
    found = _nearest(table, query, max(CANDIDATES, 4 * top), condition, _VERIFIED)
    if not intact(found.select(_VERIFIED)).all():
        raise ValueError(f"{table.uri} is damaged; ssrvlad db verify tells where")
    best = match(query[None], matrix(found[_COLUMN]).copy(), top, threshold)
    frames = found["frame"].to_pylist()
    pairs = zip(best.indices[0].tolist(), best.scores[0].tolist(), strict=True)
    return [(frames[row], score) for row, score in pairs if row >= 0]


def _condition(sequences: Collection[str] | None, exclude: Collection[str]) -> str | None:
    """What Lance filters by, in SQL."""
    limits = []
    if sequences is not None:
        limits.append(f"sequence IN ({_quoted(sequences)})")
    if exclude:
        limits.append(f"frame NOT IN ({_quoted(exclude)})")
    return " AND ".join(limits) or None


def _quoted(texts: Collection[str]) -> str:
    return ", ".join("'" + text.replace("'", "''") + "'" for text in texts)


def _compare(database: Database) -> tuple[dict[int, float], float]:
    """Recall against exact search, and the median time of a query in milliseconds."""
    frames = list(database.known())
    chosen = np.random.default_rng(0).choice(len(frames), min(_SAMPLE, len(frames)), replace=False)
    queries, exact = _exact(database, np.sort(chosen))
    found, times = [], []
    for query, row in zip(queries, np.sort(chosen), strict=True):
        began = time.perf_counter()
        [candidates] = search_index(database, query[None], 10, exclude=[[frames[row]]])
        times.append(time.perf_counter() - began)
        found.append([frame for frame, _ in candidates])
    best = [[frames[row] for row in rows if row >= 0] for rows in exact.tolist()]
    recall = {}
    for n in (1, 10):
        hits = sum(len({*b[:n]} & {*f[:n]}) for b, f in zip(best, found, strict=True))
        recall[n] = hits / max(1, sum(len(b[:n]) for b in best))
    return recall, 1000 * float(np.median(times))


def _exact(database: Database, rows: npt.NDArray[np.int64]) -> tuple[Tensor, Tensor]:
    """Some rows, and the rows of their 10 best matches but themselves, read batch by batch."""
    table = database.table()
    queries = torch.from_numpy(matrix(table.take(rows.tolist(), columns=[_COLUMN])[_COLUMN]).copy())
    scores = torch.full((len(rows), 10), -torch.inf)
    indices, first = torch.full((len(rows), 10), -1), 0
    for batch in read_rows(table):
        own = np.clip(np.stack([rows, rows + 1], axis=1) - first, 0, len(batch))
        found = match(queries, matrix(batch[_COLUMN]).copy(), 10, exclude=own)
        places = torch.where(found.indices < 0, -1, found.indices + first)
        scores, order = torch.cat([scores, found.scores], 1).topk(10)
        indices = torch.cat([indices, places], 1).gather(1, order)
        first += len(batch)
    return queries, indices
