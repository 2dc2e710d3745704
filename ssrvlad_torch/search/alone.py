"""Pictures that are judged alone in a large map: coarse candidates of all channels, scored exactly.

The scores of each channel become z-scores over the map and are fused as `recognition.fusion` says:
first those of the coarse forms for all rows, then those of the stored descriptors for the best,
with the spread of a sample of the map. So a candidate may be missed, and scores are nearly those of
exact search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..channels.channel import Channel
from ..database.database import Database
from ..recognition.fusion import Scale, fused, weights_of
from ..recognition.motion import ELSEWHERE, MIN_SPREAD
from .coarse_index import LEAST_ROWS, CoarseIndex, is_indexed, taken

COARSE, EXACT = 1000, 50
"""Rows by the fused coarse scores, of which the most trusted channel is scored exactly; and rows of
which all are. More find more, and take longer: docs/scale.md."""

LEADS = 300
"""Rows by the coarse scores of a channel that show the width of its sweep."""

_PRESELECTED, _STRIDE = 20_000, 61


def opened_large(database: Database, channels: Sequence[Channel]) -> LargeMap | str:
    """A database with an index, from `LEAST_ROWS` frames on; else why it is searched in memory,
    empty for a smaller one and one without an index."""
    if len(database) < LEAST_ROWS or not is_indexed(database):
        return ""
    try:
        return LargeMap(database, channels)
    except ValueError as error:
        return str(error)


class LargeMap:
    """A database with a coarse index, opened.

    Attributes:
        database, index: opened.
        channels: the most trusted first.
        frames: all frames, without descriptors, in natural order.
        stored, natural: ``(R,)``, where each of them is stored, and where each stored one stands.
        share: the weights of the channels by their names; their sum is 1.
        weights: the same of several channels, nothing of one.
    """

    def __init__(self, database: Database, channels: Sequence[Channel]) -> None:
        """Errors as for `CoarseIndex`."""
        self.database = database
        self.channels = sorted(channels, key=lambda channel: -channel.trust)
        self.index = CoarseIndex(database)
        self.frames, self.stored = database.placed()
        self.natural = torch.from_numpy(np.argsort(self.stored))
        self._size = len(next(iter(self.index.sample.values())))
        self._some = torch.arange(self._size) * len(self.frames) // self._size
        trust = {channel.column.name: channel.trust for channel in self.channels}
        self.share = weights_of(dict.fromkeys(trust, 0.0), trust)
        self.weights = self.share if len(trust) > 1 else {}

    @torch.no_grad()
    def found(
        self, descriptors: Mapping[str, Tensor], sweep: bool, top: int, where: Tensor | None = None
    ) -> Found:
        """The candidates of one query by its descriptors ``(*shape)``, or ``(S, *shape)`` from all
        anchors, among all rows or ``where`` ``(R,)`` bool."""
        coarse = {
            name: self.index.scan(name, [descriptors[name]], sweep)[0]
            for name in (channel.column.name for channel in self.channels)
        }
        stored = None if where is None else where[self.natural]
        rows = self.natural[self._best(coarse, stored, descriptors, sweep)].sort().values
        most, *others = self.channels
        compared = {most.column.name: self._compared(most, descriptors, coarse, rows, sweep)}
        if others:
            chosen = self._finer(compared, coarse, rows, max(top, EXACT))
            kept = torch.cat((torch.arange(self._size), self._size + chosen))
            compared = {n: c._replace(scores=c.scores[kept]) for n, c in compared.items()}
            rows = rows[chosen]
        for channel in others:
            found = self._compared(channel, descriptors, coarse, rows, sweep)
            compared[channel.column.name] = found
        scores = self._fused({name: each.scores for name, each in compared.items()})
        return Found(rows, scores, max(each.width for each in compared.values()))

    def _best(
        self,
        coarse: Mapping[str, Tensor],
        where: Tensor | None,
        query: Mapping[str, Tensor],
        sweep: bool,
    ) -> Tensor:
        """The `COARSE` best stored rows by the fused coarse scores ``(R,)``, best first. Rows are
        chosen by z-scores of cosines before those of nearness, and before all layers of codes,
        which take longer."""
        linear = torch.zeros(len(self.frames))  # the weighted z-scores, but for a constant
        for name, scores in coarse.items():
            linear.add_(scores, alpha=self.factor(name, scores))
        if where is not None:
            linear.masked_fill_(~where, -torch.inf)
        some, least = linear[::_STRIDE], -torch.inf
        if len(linear) > _PRESELECTED:
            preselected = max(1, len(some) * _PRESELECTED // len(linear))
            least = float(some.topk(preselected).values[-1])
        rows = ((linear >= least) & (linear > -torch.inf)).nonzero()[:, 0]
        chosen = torch.cat((self._every(torch.arange(len(linear))), rows))
        parts = [each[chosen] for each in coarse.values()]
        for number, name in enumerate(coarse):
            again = self.index.rescan(name, query[name], chosen, sweep)
            parts[number] = parts[number] if again is None else again
        near = self._fused(dict(zip(coarse, parts, strict=True)))
        return rows[near.topk(min(COARSE, len(rows))).indices]

    def factor(self, name: str, scores: Tensor) -> float:
        """What the coarse scores ``(R,)`` of a query by a channel count in a weighted z-score."""
        deviation = float(self._every(scores).std(correction=0))
        return self.share[name] / max(deviation, MIN_SPREAD)

    def _every(self, coarse: Tensor) -> Tensor:
        """Coarse scores ``(R,)`` of as many rows as the sample has, all over the map."""
        return coarse[self._some]

    def _finer(
        self,
        compared: Mapping[str, _Compared],
        coarse: Mapping[str, Tensor],
        own: Tensor,
        count: int,
    ) -> Tensor:
        """Which of the candidates are best by the exact scores of one channel and the coarse ones
        of the others, rising."""
        stored = torch.from_numpy(self.stored[own.numpy()])
        parts = {
            name: compared[name].scores[: self._size + len(own)]
            if name in compared
            else torch.cat((self._every(scores), scores[stored]))
            for name, scores in coarse.items()
        }
        best = self._fused(parts)
        return best.topk(min(count, len(own))).indices.sort().values

    def _compared(
        self,
        channel: Channel,
        descriptors: Mapping[str, Tensor],
        coarse: Mapping[str, Tensor],
        rows: Tensor,
        sweep: bool,
    ) -> _Compared:
        """One query against the sample and some rows by one channel. The width of a sweep is chosen
        by leads over the map, so the best rows of the channel are compared as well."""
        name, query = channel.column.name, descriptors[channel.column.name]
        swept = sweep and query.ndim > len(channel.column.shape)
        unique = rows.unique()
        if swept:
            best = coarse[name].topk(min(LEADS, len(self.frames))).indices
            unique = torch.cat((rows, self.natural[best])).unique()
        places = torch.arange(len(unique))
        if swept and len(unique):  # as far apart as in the map
            places[1:] += (unique.diff().clamp(max=ELSEWHERE + 1) - 1).cumsum(0)
        sample, stored = self.index.sample[name], self.stored[unique.numpy()]
        between = torch.arange(int(places[-1]) + 1 if len(places) else 0) % self._size
        known = torch.cat((sample, sample[between]))
        known[self._size + places] = taken(self.database, stored, [channel.column])[name]
        references = channel.references(known, [""] * len(known))
        each = references.compare(query[None], False, sweep, None)
        at = self._size + places[torch.searchsorted(unique, rows)]
        wanted = torch.cat((torch.arange(self._size), at))
        return _Compared(each[0][wanted], each.width)

    def _fused(self, parts: Mapping[str, Tensor]) -> Tensor:
        """The fused scores of some rows by those of each channel, after those of the sample."""
        if len(parts) == 1:
            return next(iter(parts.values()))[self._size :]
        scales = [Scale.of(each[: self._size]) for each in parts.values()]
        others = [each[self._size :] for each in parts.values()]
        return fused(others, [self.share[name] for name in parts], scales)


class AloneSearch:
    """Candidates of queries, each judged alone and swept as wide as suits it; a
    `native.decide.Search`.

    Args:
        descriptors: of the queries by channel, from all anchors if they are swept.
        where: ``(R,)`` bool, the rows that may be candidates.
        own: ``(Q, 2)``, for each query the first of some rows that may not, and the one after the
            last.
    """

    def __init__(
        self,
        large: LargeMap,
        descriptors: Mapping[str, Tensor],
        sweep: bool,
        top: int,
        where: npt.NDArray[np.bool_],
        own: npt.NDArray[np.int64],
    ) -> None:
        self.width, self.weights, self._found = 0, large.weights, dict[int, Found]()
        self._large, self._queries, self._sweep, self._top = large, descriptors, sweep, top
        self._where, self._own = torch.from_numpy(where), own
        self._everywhere = bool(where.all()) and bool((own[:, 0] >= own[:, 1]).all())

    def __len__(self) -> int:
        return len(next(iter(self._queries.values())))

    def _of(self, query: int) -> Found:
        if query not in self._found:
            given = {name: each[query] for name, each in self._queries.items()}
            where = None if self._everywhere else self._may(query)
            self._found = {query: self._large.found(given, self._sweep, self._top, where)}
            self.width = max(self.width, self._found[query].width)
        return self._found[query]

    def candidates(self, query: int) -> Tensor:
        """See `native.decide.Search`."""
        return self._of(query).rows

    def scores(self, query: int, rows: npt.NDArray[np.int64], /) -> Tensor:
        """See `native.decide.Search`."""
        found = torch.full((len(self._large.frames),), -torch.inf)
        found[self._of(query).rows] = self._of(query).scores
        return found[torch.as_tensor(rows)]

    def spread(self, query: int) -> tuple[float, float]:
        """See `native.decide.Search`; queries that are judged alone need none."""
        raise NotImplementedError

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """See `native.decide.Search`; all rows, of which so many may match."""
        if self._everywhere:
            return torch.zeros(1, dtype=torch.int64), torch.zeros(1)
        may = self._may(query)
        return torch.arange(len(may)), torch.zeros(len(may)).masked_fill(~may, -torch.inf)

    def _may(self, query: int) -> Tensor:
        may, (first, last) = self._where.clone(), self._own[query]
        may[first:last] = False
        return may


class Found(NamedTuple):
    """The candidates of a query, rising, their scores, and the width of the sweep."""

    rows: Tensor
    scores: Tensor
    width: int


class _Compared(NamedTuple):
    """The scores ``(N,)`` of one query against the sample of a map and candidates, and the width of
    the sweep."""

    scores: Tensor
    width: int
