"""Shortlist: some rows of a map that is too large to compare with all, for the queries of one
sequence. By the codes of its index the rows that are most like each query are found. These, the
rows beside them and a random sample of the others, with what their sequences lose, the mean of some
of their frames, stand for the whole map: the core decides on them as it decides on all rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import Channel
from ..database.database import Database
from ..native.map import DescriptorMap
from ..native.map import Shortlist as Rows
from ..recognition.recognise import runs
from ..recognition.sequences import SAME_PLACE_ROWS, sharing
from .index import Index, MapRows, read_rows

MOST, LEAST, ROWS, MOST_ROWS = 300, 40, 12_000, 100_000
"""Candidates of a query, at most and at least, so that all queries have about `ROWS`; and rows that
are read for one sequence, at most."""

AROUND = 10
"""Candidates of a query, the best, of which the rows beside are read too."""

OF_CHANNEL = 30
"""Candidates by each channel of a query that is judged alone: how far the first row of a channel is
ahead of others says which anchors count."""

SAMPLE = 1000
"""Rows of a random sample, which show how scores are spread over the map."""

MEAN_ROWS, MEANS = 64, 1000
"""Frames, at equal distances, of which the mean of a sequence is made; and means that are kept."""

STEP, SCANNED = 4, 32
"""Of a sequence that is followed, every fourth query is compared with all codes, or more, so that
it is so many of a shorter one: the others are beside their candidates."""

_AT_ONCE, _LEAST = 8, 1e-6


class Shortlist:
    """Chooses and reads rows of a database with an index.

    Attributes:
        frames: all frames, without descriptors, in natural order.
    """

    def __init__(self, database: Database, channels: Sequence[Channel]) -> None:
        """Errors as for `Index`, and a ValueError if it lacks rows."""
        self._database, self._channels = database, channels
        self._index = Index(database, MapRows.of(database))
        self._codes, self.frames = self._index.codes(), self._index.rows.frames
        self._lengths = [*map(len, runs(self.frames.sequences))]
        everyone = np.random.default_rng(0).permutation(len(self.frames))
        self._sample = np.sort(everyone[:SAMPLE])
        self._sampled = self.read(self._sample)
        self._means = dict[int, dict[str, npt.NDArray[np.float32]]]()
        ends, groups = np.cumsum([0, *self._lengths]), sharing(self._lengths)
        self._starts = np.array([ends[group[0]] for group in groups], np.int64)
        self._mean_rows = [
            np.linspace(ends[group[0]], ends[group[-1] + 1] - 1, MEAN_ROWS).astype(np.int64)
            if group == members
            else self._sample
            for group, members in groups.items()
        ]

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
        unlisted = allowed.copy()
        unlisted[likely] = False
        sample, count = self._sample[unlisted[self._sample]], int(unlisted.sum())
        if len(sample) < min(SAMPLE, count) / 2:  # few of the fixed sample are allowed
            rows = np.flatnonzero(unlisted)
            sample = np.random.default_rng(0).choice(rows, min(SAMPLE, count), replace=False)
        rows = np.concatenate([likely, sample])
        weights = np.ones(len(rows))
        weights[len(likely) :] = count / max(1, len(sample))
        order = np.argsort(rows)
        return self._map_of(rows[order], weights[order], standardise)

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
        step = min(STEP, max(1, count // SCANNED)) if followed else 1
        scanned = np.unique([*range(0, count, step), count - 1])
        most = min(max(top, min(MOST, max(LEAST, ROWS // len(scanned)))), int(allowed.sum()))
        forbidden, best = torch.from_numpy(~allowed), list[npt.NDArray[np.int64]]()
        of_channel = min(OF_CHANNEL, most)
        for batch in np.array_split(scanned, -(-len(scanned) // _AT_ONCE)):
            channels = self._scores({name: rows[batch] for name, rows in queries.items()}, sweep)
            for scores in channels:
                scores.masked_fill_(forbidden, -torch.inf)
                for query, row in zip(batch.tolist(), scores, strict=True):
                    if excluded is not None:
                        row[slice(*excluded[query])] = -torch.inf
            together = torch.stack(channels).sum(0).topk(most)
            alone = [] if followed else [scores.topk(of_channel) for scores in channels]
            best.append(torch.cat([b.indices for b in (together, *alone)], 1).numpy())
        ranked = np.concatenate(best)
        reach = np.arange(-SAME_PLACE_ROWS * step, SAME_PLACE_ROWS * step + 1)
        beside = (ranked[:, :AROUND, None] + reach).transpose(1, 2, 0).ravel()
        rows = np.concatenate([ranked[:, :top].T.ravel(), beside, ranked[:, top:].T.ravel()])
        rows = rows[(rows >= 0) & (rows < len(allowed))]
        rows = rows[allowed[rows]]
        _, first = np.unique(rows, return_index=True)
        return np.sort(rows[np.sort(first)[:MOST_ROWS]])

    def _scores(self, queries: Mapping[str, Tensor], sweep: bool) -> list[Tensor]:
        """``(Q, R)`` by each channel, scores of queries to all rows by their codes, in deviations
        and weighted by trust."""
        scores = list[Tensor]()
        for channel in self._channels:
            name = channel.name
            of = self._index.coders[name].scores(queries[name], self._codes[name], sweep)
            deviation = of[:, self._sample].std(1, correction=0).clamp(min=_LEAST)
            scores.append(of.mul_(channel.trust / deviation[:, None]))
        return scores

    def _map_of(
        self, rows: npt.NDArray[np.int64], weights: npt.NDArray[np.float64], standardise: bool
    ) -> DescriptorMap:
        """Rows with what they lose, as a map."""
        groups, with_means = np.zeros(len(rows), np.int64), standardise and len(self._starts)
        if with_means:
            groups = np.searchsorted(self._starts, rows, side="right") - 1
        changes = np.flatnonzero(np.diff(groups, prepend=-1))
        means = [self._mean(group) for group in groups[changes].tolist()] if with_means else []
        town = DescriptorMap(self._lengths, Rows(rows, weights, changes))
        in_sample = np.isin(rows, self._sample)
        of_sample = np.searchsorted(self._sample, rows[in_sample])
        read = self.read(rows[~in_sample])
        for channel in self._channels:
            name = channel.name
            values = np.empty((len(rows), *read[name].shape[1:]), read[name].dtype)
            values[~in_sample], values[in_sample] = read[name], self._sampled[name][of_sample]
            lost = np.stack([mean[name] for mean in means]) if means else None
            town.add(name, values, channel.trust, lost)
        return town

    def _mean(self, group: int) -> dict[str, npt.NDArray[np.float32]]:
        """What the rows of a part of the map lose, by channel."""
        if group not in self._means:
            if len(self._means) >= MEANS:
                self._means.clear()
            read = self.read(np.unique(self._mean_rows[group]))
            self._means[group] = {name: mean_of(values) for name, values in read.items()}
        return self._means[group]

    def read(self, rows: npt.NDArray[np.int64]) -> dict[str, npt.NDArray[Any]]:
        """Descriptors of rows by channel."""
        columns, stored = [c.column for c in self._channels], self._index.rows.stored[rows]
        read = read_rows(self._database, stored, columns, verified=True)
        return {name: values.numpy() for name, values in read.items()}


def mean_of(descriptors: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """``(D,)``, the mean of descriptors ``(N, *shape)``: of vectors at length 1 that are not zero,
    of signs as 1 and -1."""
    if descriptors.dtype == np.uint8:
        bits = np.unpackbits(descriptors.reshape(len(descriptors), -1), axis=1, bitorder="little")
        signs: npt.NDArray[np.float32] = (2 * bits.mean(0) - 1).astype(np.float32)
        return signs
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    total = (descriptors / np.maximum(lengths, _LEAST)).sum(0)
    mean: npt.NDArray[np.float32] = total / max(1, np.count_nonzero(lengths))
    return mean
