"""Candidates of queries by a database's index, for `recognition.candidates`: what following and
confidence need of a search, read row by row."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from ..recognition.matching import Rows
from ..recognition.motion import moments
from ..recognition.standardise import less, standardise
from ..recognition.sweep import score
from .index import CANDIDATES, filter_of, indexed, nearest
from .reading import read_rows
from .rows import DESCRIPTOR, intact, matrix
from .selection import neighbours, select

if TYPE_CHECKING:
    import pyarrow as pa
    from torch import Tensor

    from .database import Database

_SAMPLE_ROWS = 1000
_ROWS_KEPT = 50_000
_ALONG = 8
_AHEAD, _THREADS = 8, 2


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
        self._table = indexed(database)
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
        self._condition = filter_of(allowed)
        ids, reach = spared
        self._exclude = None if reach is None else neighbours(ids, self.frames, reach)
        self._columns = [DESCRIPTOR] if standardised else self._table.schema.names
        self._slots, self._kept = torch.full((len(self.frames),), -1), 0
        self._vectors = torch.empty(0, database.width)
        self._found: dict[int, Tensor] = {}
        self._samples: dict[int, Tensor] = {}
        self._scored: dict[int, tuple[Tensor, Tensor]] = {}
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
        """See `recognition.candidates.Search`; scores are remembered, for a second pass."""
        known, scores = self._scored.get(query, (rows[:0], torch.empty(0)))
        fresh = rows[~torch.isin(rows, known)]
        if len(fresh):
            known, order = torch.cat([known, fresh]).sort()
            scores = torch.cat([scores, self._score(query, fresh)])[order]
            self._scored[query] = known, scores
        return scores[torch.searchsorted(known, rows)]

    def _score(self, query: int, rows: Tensor) -> Tensor:
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
        return nearest(self._table, vector, CANDIDATES, self._condition, self._columns)

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
        if "checksum" in self._columns and not intact(found.select(self._columns)).all():
            raise ValueError(f"{self._table.uri} is damaged; ssrvlad db verify tells where")
        vectors = torch.from_numpy(matrix(found[DESCRIPTOR]).copy())
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
        totals = np.zeros((count, int(self._table.schema.field(DESCRIPTOR).type.list_size)))
        counted, first = np.zeros(count), 0
        for batch in read_rows(self._table):
            vectors = F.normalize(torch.from_numpy(matrix(batch[DESCRIPTOR]).copy()), dim=1).numpy()
            drives = self._drives[self._rows[first : first + len(batch)]]
            for drive in np.unique(drives):
                totals[drive] += vectors[drives == drive].sum(0, dtype=np.float64)
            np.add.at(counted, drives, vectors.any(axis=1))
            first += len(batch)
        return torch.from_numpy(totals / np.maximum(counted, 1)[:, None]).float()
