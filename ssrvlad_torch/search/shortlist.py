"""Shortlist: some rows of a map that is too large to compare with all, for the queries of one
sequence.

The coarse index finds likely rows for each query. These, the rows beside them and a random sample
of the others are read from disk, with what their sequences lose, and stand for the whole map: the
core decides on them as it decides on all rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import Channel
from ..database.database import Database
from ..native.map import DescriptorMap
from ..native.map import Shortlist as Rows
from ..recognition.sequences import runs
from ..recognition.standardise import MIN_FRAMES, sharing
from .coarse_index import LEAST_ROWS, CoarseIndex, is_indexed, taken

MOST, LEAST, ROWS = 1000, 40, 12_000
"""Candidates of a query: at most and at least so many, together about so many rows."""

SAMPLE = 1000
"""Rows of a random sample, which show how scores are spread over the map."""

EVERY, SCANNED = 4, 32
"""Of a sequence that is followed, every fourth query is compared with the whole index, or more, so
that it is so many of a shorter one: the others are beside their candidates."""

_AT_ONCE, _LEAST = 8, 1e-6


def open_shortlist(database: Database, channels: Sequence[Channel]) -> tuple[Shortlist | None, str]:
    """The shortlist of a database with an index, from `LEAST_ROWS` frames on; or none, and why,
    empty for a smaller database and for one without an index."""
    if len(database) < LEAST_ROWS or not is_indexed(database):
        return None, ""
    try:
        return Shortlist(database, channels), ""
    except ValueError as error:
        return None, str(error)


class Shortlist:
    """Chooses and reads rows of a database with a coarse index.

    Attributes:
        frames: all frames, without descriptors, in natural order.
    """

    def __init__(self, database: Database, channels: Sequence[Channel]) -> None:
        """Errors as for `CoarseIndex`."""
        self._database, self._channels = database, channels
        self._index = CoarseIndex(database)
        self.frames, self._stored = database.placed()
        self._natural = np.argsort(self._stored)
        parts = [*runs(self.frames.sequences)]
        self._lengths = [len(part) for part in parts]
        names = [self.frames.sequences[part.start] for part in parts]
        self._mean_of, self._members = np.zeros(len(parts), np.int64), list[list[str]]()
        for group, members in sharing(self._lengths).items():
            self._mean_of[[*group]] = len(self._members)
            self._members.append([names[member] for member in members])

    @torch.no_grad()
    def of(
        self,
        queries: Mapping[str, Tensor],
        standardise: bool,
        sweep: bool,
        followed: bool,
        top: int,
        allowed: npt.NDArray[np.bool_],
        excluded: npt.NDArray[np.int64] | None = None,
    ) -> DescriptorMap:
        """The rows for the queries of one sequence by their raw descriptors; the other arguments as
        for `recognise`."""
        likely = self._likely(queries, sweep, followed, top, allowed, excluded)
        others = allowed.copy()
        others[likely] = False
        rest = np.flatnonzero(others)
        sample = np.random.default_rng(0).choice(rest, min(SAMPLE, len(rest)), replace=False)
        rows = np.concatenate([likely, sample])
        weights = np.ones(len(rows))
        weights[len(likely) :] = len(rest) / max(1, len(sample))
        order = np.argsort(rows)
        return self._read(rows[order], weights[order], standardise)

    def _likely(
        self,
        queries: Mapping[str, Tensor],
        sweep: bool,
        followed: bool,
        top: int,
        allowed: npt.NDArray[np.bool_],
        excluded: npt.NDArray[np.int64] | None,
    ) -> npt.NDArray[np.int64]:
        """The rows that are most like some queries, rising, with those beside them."""
        count = len(next(iter(queries.values())))
        step = min(EVERY, max(1, count // SCANNED)) if followed else 1
        scanned = np.unique([*range(0, count, step), count - 1])
        most = min(max(top, min(MOST, max(LEAST, ROWS // len(scanned)))), int(allowed.sum()))
        forbidden = torch.from_numpy(~allowed[self._natural])
        found, best = list[npt.NDArray[np.int64]](), list[npt.NDArray[np.int64]]()
        for first in range(0, len(scanned), _AT_ONCE):
            some = torch.from_numpy(scanned[first : first + _AT_ONCE])
            scores = self._coarse({name: of[some] for name, of in queries.items()}, sweep)
            scores.masked_fill_(forbidden, -torch.inf)
            for query, row in zip(some.tolist(), scores, strict=True):
                if excluded is not None:
                    row[self._stored[slice(*excluded[query])]] = -torch.inf
                chosen = self._natural[row.topk(most).indices.numpy()]
                found.append(chosen)
                best.append(chosen[:LEAST])
        reach = np.arange(-3 * step, 3 * step + 1) if followed else np.arange(-1, 2)
        beside = (np.concatenate(best)[:, None] + reach).ravel()
        beside = beside[(beside >= 0) & (beside < len(allowed))]
        rows = np.unique(np.concatenate([*found, beside]))
        likely: npt.NDArray[np.int64] = rows[allowed[rows]]
        return likely

    def _coarse(self, queries: Mapping[str, Tensor], sweep: bool) -> Tensor:
        """``(Q, R)`` coarse scores of queries to all stored rows, by all channels as one: sums of
        deviations, weighted by trust."""
        total = torch.zeros(len(next(iter(queries.values()))), len(self._stored))
        every = max(1, len(self._stored) // SAMPLE)
        for channel in self._channels:
            name = channel.column.name
            scores = self._index.scan(name, [*queries[name]], sweep)
            deviation = scores[:, ::every].std(1, correction=0).clamp(min=_LEAST)
            total.add_(scores.mul_(channel.trust / deviation[:, None]))
        return total

    def _read(
        self, rows: npt.NDArray[np.int64], weights: npt.NDArray[np.float64], standardise: bool
    ) -> DescriptorMap:
        """Rows with what they lose, as a map."""
        sequences = np.repeat(np.arange(len(self._lengths)), self._lengths)[rows]
        group = self._mean_of[sequences] if standardise else np.zeros(len(rows), np.int64)
        starts = np.flatnonzero(np.diff(group, prepend=-1))
        town = DescriptorMap(self._lengths, Rows(rows, weights, starts))
        columns = [channel.column for channel in self._channels]
        read = taken(self._database, self._stored[rows], columns, verified=True)
        with_means = standardise and len(self.frames) >= MIN_FRAMES
        for channel in self._channels:
            name = channel.column.name
            means = [self._mean(name, number) for number in group[starts]] if with_means else None
            stacked = None if means is None else torch.stack(means).numpy()
            town.add(name, read[name].numpy(), channel.trust, stacked)
        return town

    def _mean(self, name: str, group: int) -> Tensor:
        """What is subtracted from the frames of a group of sequences."""
        return self._index.mean(name, self._members[group])
