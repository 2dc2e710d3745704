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
from ..database.frames import FrameSet
from ..recognition.fusion import Scale, fused, nearness, weights_of
from ..recognition.matching import Matches, best_of
from ..recognition.motion import ELSEWHERE, MIN_SPREAD
from ..recognition.recognise import Recognised, Steps, recognise_alone
from ..recognition.rivals import Chance, chance_of
from ..recognition.sequences import runs
from .coarse_index import LEAST_ROWS, CoarseIndex, is_indexed, taken
from .selection import neighbours

COARSE, EXACT = 1000, 50
"""Rows by the fused coarse scores, of which the most trusted channel is scored exactly; and rows of
which all are. More find more, and take longer: docs/scale.md."""

LEADS = 300
"""Rows by the coarse scores of a channel that show the width of its sweep."""

_PRESELECTED, _STRIDE = 20_000, 61


class Judged(NamedTuple):
    """The candidates of a query that is judged alone, how the first compares with its rivals, and
    the width of the sweep."""

    matches: Matches
    chance: Chance
    width: int


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
    def judge(
        self,
        descriptors: Mapping[str, Tensor],
        sweep: bool,
        top: int,
        allowed: npt.NDArray[np.bool_] | None = None,
    ) -> Judged:
        """The candidates of one query by its descriptors ``(*shape)``, or ``(S, *shape)`` from all
        anchors. ``allowed`` ``(R,)`` bool are the rows that may be candidates, by default all."""
        where = None if allowed is None else torch.from_numpy(allowed)[self.natural]
        coarse = {
            name: self.index.scan(name, [descriptors[name]], sweep)[0]
            for name in (channel.column.name for channel in self.channels)
        }
        rows = self.natural[self._best(coarse, where, descriptors, sweep)].sort().values
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
        matching = len(self.frames) if allowed is None else int(allowed.sum())
        chance = chance_of(nearness(scores), rows, matching)
        width = max(each.width for each in compared.values())
        return Judged(best_of(scores, top, rows), chance, width)

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


def recognise_in_large(
    large: LargeMap,
    queries: FrameSet,
    steps: Steps,
    top: int,
    where: npt.NDArray[np.bool_],
    exclude: int | None = None,
) -> Recognised:
    """The candidates of queries, each judged alone and swept as wide as suits it, among the rows
    ``where`` ``(R,)`` bool of a large map; ``exclude`` as for `exact.search`."""
    own, everywhere = neighbours(queries.frames, large.frames, exclude), bool(where.all())
    judged = list[Judged]()
    for query, (first, last) in enumerate(own.tolist()):
        allowed = where
        if last > first:
            allowed = where.copy()
            allowed[first:last] = False
        descriptors = {name: values[query] for name, values in queries.channels.items()}
        some = None if everywhere and last <= first else allowed
        judged.append(large.judge(descriptors, steps.sweep, top, some))
    parts = {queries.sequences[run.start]: run for run in runs(queries.sequences)}
    return recognise_alone(
        {name: [judged[query][:2] for query in run] for name, run in parts.items()},
        {name: max(judged[query].width for query in run) for name, run in parts.items()},
        large.weights,
        len(large.frames),
        steps,
        top,
    )


class _Compared(NamedTuple):
    """The scores ``(N,)`` of one query against the sample of a map and candidates, and the width of
    the sweep."""

    scores: Tensor
    width: int
