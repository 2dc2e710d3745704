"""Candidates by a database's index, for `recognise_by_search`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from ..database.engine import require_unforked
from ..database.reading import read_rows
from ..database.rows import intact, matrix
from ..encoding.results import Progress, do_nothing
from ..recognition.matching import Rows
from ..recognition.motion import moments
from ..recognition.recognise import Steps, recognise_by_search
from ..recognition.standardise import MIN_FRAMES, sharing, standardise, without_mean
from ..recognition.sweep import score
from .answers import Answers
from .exact import chosen_channels, queries_of
from .index import CANDIDATES, condition_of, nearest, require_index
from .selection import neighbours, select

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa
    from lance import LanceDataset
    from torch import Tensor

    from ..database.database import Database
    from ..encoding.source import Source

_SAMPLE_ROWS = 1000
_CACHED_ROWS = 50_000
_READ_AROUND = 8
_QUERIES_AHEAD, _THREADS = 8, 2


class IndexSearch:
    """Candidates of queries by a database's index; a `native.decide.Search`.

    The index holds raw descriptors. With ``standardised`` it is searched for the rows nearest to
    each query minus the mean of the query's sequence. A row is scored after the mean of its own
    sequence, over all frames of the version that is read, is subtracted as well. Scores are those
    of exact search, but a candidate may be missed.

    Queries are ``(Q, D)`` raw descriptors. Candidates are of the sequences ``allowed``, by default
    all, and not within a number of frames of the query's own id; ``excluded`` has the ids and the
    number, ``None`` for no limit. Row numbers are positions in ``frames``, all frames of the
    database in natural order, without descriptors. No index, a missing sequence, and damage are a
    ValueError.
    """

    def __init__(
        self,
        database: Database,
        queries: Tensor,
        query_sequences: Sequence[str],
        standardised: bool = True,
        allowed: Collection[str] | None = None,
        excluded: tuple[Sequence[str], int | None] = ((), None),
    ) -> None:
        self._table, self._column = require_index(database), database.columns[0].name
        self.frames, stored = database.placed()
        self._row_of_stored = np.argsort(stored)
        ids = self._table.to_table(columns=[], with_row_id=True, scan_in_order=True)
        self._stored_ids = ids["_rowid"].to_numpy()
        names = list(dict.fromkeys(self.frames.sequences))
        number = {name: n for n, name in enumerate(names)}
        self._sequences = np.array([number[name] for name in self.frames.sequences], np.int32)
        self._allowed = None
        if allowed is not None:
            select(self.frames, allowed)
            self._allowed = torch.tensor([name in set(allowed) for name in names])
        self._condition = condition_of(allowed)
        ids, reach = excluded
        self._excluded = None if reach is None else neighbours(ids, self.frames, reach)
        means = self._mean_of_each(len(names)) if standardised else None
        self._queries = standardise(queries, query_sequences) if standardised else queries
        self._cache = _RowCache(self._table, self._column, stored, self._sequences, means)
        self._candidates: dict[int, Tensor] = {}
        self._pending: dict[int, Future[pa.Table | None]] = {}
        self._pool = ThreadPoolExecutor(_THREADS)
        self._scores: dict[int, tuple[Tensor, Tensor]] = {}
        rows = len(self.frames)
        chosen = np.random.default_rng(0).choice(rows, min(_SAMPLE_ROWS, rows), replace=False)
        self._sample = torch.from_numpy(np.sort(chosen))
        self._sample_rows = Rows.of(self._cache.read(self._sample))
        self._sample_scores: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._queries)

    def candidates(self, query: int) -> Tensor:
        """See `native.decide.Search`."""
        if query not in self._candidates:
            require_unforked()
            for later in range(query, min(query + _QUERIES_AHEAD, len(self))):
                if later not in self._pending and later not in self._candidates:
                    self._pending[later] = self._pool.submit(self._nearest, later)
            rows, found = torch.zeros(0, dtype=torch.int64), self._pending.pop(query).result()
            if found is not None:
                stored = np.searchsorted(self._stored_ids, found["_rowid"].to_numpy())
                rows = torch.from_numpy(self._row_of_stored[stored])
                self._cache.add(rows, found)
            self._candidates[query] = rows[self._may_match(query, rows)]
        return self._candidates[query]

    def scores(self, query: int, given: Tensor | npt.NDArray[np.int64], /) -> Tensor:
        """See `native.decide.Search`; scores are cached for a second pass."""
        rows = torch.as_tensor(given)
        cached, scores = self._scores.get(query, (rows[:0], torch.empty(0)))
        missing = rows[~torch.isin(rows, cached)]
        if len(missing):
            fresh = score(self._queries[query][None], self._cache.read(missing))[0]
            fresh = fresh.masked_fill(~self._may_match(query, missing), -torch.inf)
            cached, order = torch.cat([cached, missing]).sort()
            scores = torch.cat([scores, fresh])[order]
            self._scores[query] = cached, scores
        return scores[torch.searchsorted(cached, rows)]

    def spread(self, query: int) -> tuple[float, float]:
        """See `native.decide.Search`."""
        return moments(self.sample(query)[1])

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """See `native.decide.Search`."""
        if query not in self._sample_scores:
            scores = score(self._queries[query][None], self._sample_rows)[0]
            self._sample_scores[query] = scores
        return self._sample, self._sample_scores[query]

    def _nearest(self, query: int) -> pa.Table | None:
        vector = self._queries[query]
        if not bool(vector.any()):
            return None
        first, last = (0, 0) if self._excluded is None else self._excluded[query].tolist()
        count = CANDIDATES + last - first  # so many are left without the excluded ones
        return nearest(
            self._table, self._column, vector, count, self._condition, self._cache.columns
        )

    def _may_match(self, query: int, rows: Tensor) -> Tensor:
        may = torch.ones(len(rows), dtype=torch.bool)
        if self._allowed is not None:
            may &= self._allowed[torch.from_numpy(self._sequences[rows.numpy()])]
        if self._excluded is not None:
            first, last = self._excluded[query].tolist()
            may &= (rows < first) | (rows >= last)
        return may

    def _mean_of_each(self, count: int) -> Tensor:
        """``(count, D)`` float32, what is subtracted from each sequence, see
        `standardise.sharing`, in one pass that verifies all rows."""
        totals = np.zeros((count, int(self._table.schema.field(self._column).type.list_size)))
        counts, first = np.zeros(count), 0
        for batch in read_rows(self._table):
            vectors = F.normalize(
                torch.from_numpy(matrix(batch[self._column]).copy()), dim=1
            ).numpy()
            sequences = self._sequences[self._row_of_stored[first : first + len(batch)]]
            for sequence in np.unique(sequences):
                totals[sequence] += vectors[sequences == sequence].sum(0, dtype=np.float64)
            np.add.at(counts, sequences, vectors.any(axis=1))
            first += len(batch)
        means = np.zeros_like(totals)
        for group, of in sharing(np.bincount(self._sequences, minlength=count).tolist()).items():
            means[list(group)] = totals[list(of)].sum(0) / max(1.0, counts[list(of)].sum())
        return torch.from_numpy(means).float()


def search_by_index(
    database: Database,
    source: Source,
    steps: Steps,
    top: int,
    sequences: Sequence[str] | None = None,
    exclude: int | None = None,
    progress: Progress = do_nothing,
) -> Answers:
    """The candidates of every frame of a source in the index of a database, by the first channel,
    without a sweep; arguments as for `exact.search`."""
    [channel] = chosen_channels(database, [database.columns[0].name])
    queries, skipped, folders = queries_of(database, source, [channel], progress=progress)
    ids, names = queries.frames, queries.sequences

    @cache
    def index(standardised: bool) -> IndexSearch:
        return IndexSearch(
            database, queries.descriptors, names, standardised, sequences, (ids, exclude)
        )

    long = names.count(names[0]) >= MIN_FRAMES if names else False
    references = index(steps.standardise and long).frames
    recognised = recognise_by_search(index, names, references.sequences, steps, top)
    return Answers.of(queries, references, recognised, 0, tuple(skipped), folders)


class _RowCache:
    """Descriptors in a column of R rows, read from disk when they are first needed: row n is
    ``stored[n]`` of the table and of the sequence of number ``sequences[n]``, whose mean, of
    ``means`` ``(S, D)``, is subtracted. Raw descriptors, without means, are verified when they are
    read."""

    def __init__(
        self,
        table: LanceDataset,
        column: str,
        stored: npt.NDArray[np.int64],
        sequences: npt.NDArray[np.int32],
        means: Tensor | None,
    ) -> None:
        self.columns = table.schema.names if means is None else [column]
        self._column = column
        self._table, self._stored, self._sequences, self._means = table, stored, sequences, means
        self._slots, self._used = torch.full((len(stored),), -1), 0
        self._vectors = torch.empty(0, int(table.schema.field(column).type.list_size))

    def read(self, rows: Tensor) -> Tensor:
        """``(N, D)`` descriptors of rows; rows around missing ones are read for later calls."""
        missing = rows[self._slots[rows] < 0]
        if len(missing):
            if self._used > _CACHED_ROWS:
                self._slots.fill_(-1)
                self._used, missing = 0, rows
            around = missing[:, None] + torch.arange(-_READ_AROUND, _READ_AROUND + 1)
            near = torch.from_numpy(np.unique(around.numpy()))
            near = near[(near >= 0) & (near < len(self._slots))]
            near = near[self._slots[near] < 0]
            stored = self._stored[near.numpy()].tolist()
            require_unforked()
            self.add(near, self._table.take(stored, columns=self.columns))
        return self._vectors[self._slots[rows]]

    def add(self, rows: Tensor, found: pa.Table) -> None:
        """Caches the descriptors of rows, given as rows of the table."""
        if "checksum" in self.columns and not intact(found.select(self.columns)).all():
            raise ValueError(f"{self._table.uri} is damaged; ssrvlad db verify shows where")
        vectors = torch.from_numpy(matrix(found[self._column]).copy())
        new = (self._slots[rows] < 0).nonzero()[:, 0]
        rows, vectors = rows[new], vectors[new]
        if self._means is not None:
            sequences = torch.from_numpy(self._sequences[rows.numpy()])
            vectors = without_mean(F.normalize(vectors, dim=1), self._means[sequences.long()])
        end = self._used + len(rows)
        if end > len(self._vectors):
            grown = self._vectors.new_empty(max(end, 2 * len(self._vectors)), vectors.shape[1])
            grown[: self._used] = self._vectors[: self._used]
            self._vectors = grown
        self._vectors[self._used : end] = vectors
        self._slots[rows] = torch.arange(self._used, end)
        self._used = end
