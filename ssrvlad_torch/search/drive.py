"""Drives in a large map: candidates of the coarse index, scored exactly and followed.

Scores are those of exact search but for the spread of a query's scores, the lead of each channel
and the width of the sweep, which are known by a sample of the map and of the queries. A candidate
may be missed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..database.frames import FrameSet
from ..recognition.comparison import References
from ..recognition.fusion import fused, weights_of
from ..recognition.motion import ELSEWHERE, MIN_SPREAD, lead, moments, nearness
from ..recognition.recognise import Recognised, Steps, recognise_by_search
from ..recognition.standardise import MIN_FRAMES, sums
from ..recognition.sweep import COLUMNS
from .coarse_index import taken
from .selection import neighbours
from .sums import mean_of, means_of

if TYPE_CHECKING:
    from ..channels.channel import Channel
    from .alone import LargeMap

CANDIDATES = 100
"""Rows by the fused coarse scores of a query, whatever it follows."""

_SAMPLE = 1000
_SAMPLED, _LEADING = 32, 30
"""Queries by which the width of a sweep and the lead of a channel are known, and how many rows that
are best by its coarse scores."""

_SCANNED, _WINDOW, _AROUND, _AHEAD = 8, 16, 3, 24
"""Queries that are scanned at once, and that are scored at once; rows to each side of a candidate,
and of a row to which a drive may have moved, that are scored with it: the next queries will ask for
them."""

_CACHED = 1 << 14


class MapRows:
    """The descriptors of rows of a map, read from disk when they are needed, and the means of their
    sequences."""

    def __init__(self, large: LargeMap) -> None:
        self._large, rows = large, len(large.frames)
        names = large.frames.sequences
        self._sequences, numbers = list(dict.fromkeys(names)), dict[str, int]()
        for name in self._sequences:
            numbers[name] = len(numbers)
        self._of = np.fromiter((numbers[name] for name in names), np.int64, rows)
        self._sharing = means_of(np.bincount(self._of).tolist())
        self._means: dict[tuple[str, tuple[int, ...]], Tensor] = {}
        self._slots, self._used = torch.full((rows,), -1), 0
        self._held: dict[str, Tensor] = {}

    @cached_property
    def sample(self) -> Tensor:
        """``(M,)`` int64, rows that represent all rows."""
        rows = len(self._of)
        chosen = np.random.default_rng(0).choice(rows, min(_SAMPLE, rows), replace=False)
        return torch.from_numpy(np.sort(chosen))

    def references(self, channel: Channel, rows: Tensor, standardised: bool) -> References:
        """Rising rows by one channel."""
        of, name = self._of[rows.numpy()], channel.column.name
        means = None
        if standardised:
            each = [self._mean(channel, number) for number in of[np.diff(of, prepend=-1) != 0]]
            means = torch.stack(each) if each else None
        known = self._read(rows, name)
        return channel.references(known, [self._sequences[number] for number in of], means)

    def _mean(self, channel: Channel, number: int) -> Tensor:
        """What is subtracted from the frames of a sequence."""
        name, those = channel.column.name, self._sharing[number]
        key = name, those if len(those) < len(self._sequences) else ()
        if key not in self._means:
            of = [self._sequences[each] for each in those]
            self._means[key] = (
                self._large.index.mean(name, of) if of else mean_of((), channel.column)
            )
        return self._means[key]

    def _read(self, rows: Tensor, name: str) -> Tensor:
        missing = rows[self._slots[rows] < 0]
        if self._used + len(missing) > _CACHED:
            self._slots.fill_(-1)
            self._used, missing = 0, rows
        if len(missing) > _CACHED:
            return self._taken(missing)[name]
        if len(missing):
            last = self._used + len(missing)
            for each, values in self._taken(missing).items():
                if each not in self._held:
                    self._held[each] = values.new_empty(_CACHED, *values.shape[1:])
                self._held[each][self._used : last] = values
            self._slots[missing] = torch.arange(self._used, last)
            self._used = last
        return self._held[name][self._slots[rows]]

    def _taken(self, rows: Tensor) -> dict[str, Tensor]:
        columns = [channel.column for channel in self._large.channels]
        return taken(self._large.database, self._large.stored[rows.numpy()], columns)


class _Swept(NamedTuple):
    """The queries of a drive by one channel, ``(Q, *shape)`` or ``(Q, S, *shape)`` from the anchors
    that count, their mean, and the width of the sweep."""

    queries: Tensor
    mean: Tensor
    width: int


class _Window(NamedTuple):
    """The scores ``(W, N)`` of some queries to rising rows ``(N,)``."""

    rows: Tensor
    scores: Tensor


class DriveSearch:
    """Candidates of the queries of one drive in a large map, and their scores; a
    `native.decide.Search`.

    Args:
        rows: of the map.
        descriptors: of the queries by channel, from all anchors if they are swept.
        standardised: subtract the mean of each drive.
        where: ``(R,)`` bool, the rows that may be candidates.
        own: ``(Q, 2)``, for each query the first of some rows that may not, and the one after the
            last.

    Attributes:
        width: of the widest sweep, in columns to each side.
        weights: of several channels by their names.
    """

    def __init__(
        self,
        large: LargeMap,
        rows: MapRows,
        descriptors: Mapping[str, Tensor],
        standardised: bool,
        sweep: bool,
        where: npt.NDArray[np.bool_],
        own: npt.NDArray[np.int64],
    ) -> None:
        self._large, self._rows, self._standardised = large, rows, standardised
        self._sweep, self._own = sweep, torch.from_numpy(own)
        self._where = torch.from_numpy(where)
        self._everywhere = bool(where.all()) and bool((own[:, 0] >= own[:, 1]).all())
        self._channels = {channel.column.name: channel for channel in large.channels}
        given = {name: descriptors[name] for name in self._channels}
        self._count = len(next(iter(given.values())))
        self._candidates: dict[int, Tensor] = {}
        self._windows: dict[int, _Window] = {}
        leading = self._leading(given)
        self._drive = {name: self._swept(name, each, leading) for name, each in given.items()}
        self.width = max(each.width for each in self._drive.values())
        every = range(self._count)
        self._sampled = {name: self._scores(name, every, rows.sample) for name in given}
        self._share = self._weighed(leading)
        self.weights = self._share if len(self._share) > 1 else {}
        parts = zip(*self._sampled.values(), strict=True)
        self._sample = [self._fused(each) for each in parts]
        self._spread = [moments(each) for each in self._sample]

    def __len__(self) -> int:
        return self._count

    def candidates(self, query: int) -> Tensor:
        """See `native.decide.Search`."""
        if query not in self._candidates:
            some = range(query, min(query + _SCANNED, self._count))
            missing = torch.tensor([each for each in some if each not in self._candidates])
            self._scanned(missing, {name: each.queries for name, each in self._drive.items()})
        return self._candidates[query]

    def scores(self, query: int, given: Tensor | npt.NDArray[np.int64], /) -> Tensor:
        """See `native.decide.Search`."""
        rows, number = torch.as_tensor(given), query // _WINDOW
        window = self._windows.get(number)
        if window is None:
            first = number * _WINDOW
            some = range(first, min(first + _WINDOW, self._count))
            near = torch.cat([rows, *(self.candidates(each) for each in some)])
            window = self._windows[number] = self._window(some, self._around(near, _AROUND))
        places = torch.searchsorted(window.rows, rows).clamp(max=len(window.rows) - 1)
        missing = rows[window.rows[places] != rows]
        if len(missing):
            first = number * _WINDOW
            near = self._around(missing, _AHEAD)
            near = near[~torch.isin(near, window.rows)]
            more = self._window(range(first, first + len(window.scores)), near)
            every, order = torch.cat([window.rows, near]).sort()
            scores = torch.cat([window.scores, more.scores], 1)[:, order]
            window = self._windows[number] = _Window(every, scores)
            places = torch.searchsorted(every, rows)
        return window.scores[query % _WINDOW, places]

    def spread(self, query: int) -> tuple[float, float]:
        """See `native.decide.Search`."""
        return self._spread[query]

    def sample(self, query: int) -> tuple[Tensor, Tensor]:
        """See `native.decide.Search`."""
        return self._rows.sample, self._sample[query]

    def _leading(self, given: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, References]]:
        """By each channel: some of the queries, and the rows that are nearest to them by the coarse
        scores, with those beside them."""
        some = torch.arange(0, self._count, max(1, self._count // _SAMPLED))
        nearest: dict[str, list[Tensor]] = {name: [] for name in given}
        for part in some.split(_SCANNED):
            for name, scores in self._scanned(part, given).items():
                best = scores.topk(min(_LEADING, scores.shape[1])).indices
                nearest[name].append(self._large.natural[best.flatten()])
        leading = {}
        for name, each in nearest.items():
            rows = self._around(torch.cat(each), ELSEWHERE)
            references = self._rows.references(self._channels[name], rows, self._standardised)
            leading[name] = rows, references
        return leading

    def _swept(
        self, name: str, given: Tensor, leading: Mapping[str, tuple[Tensor, References]]
    ) -> _Swept:
        """The queries as wide as suits the rows that are nearest to them."""
        shape = len(self._channels[name].column.shape)
        width, queries, middle = 0, given, given.shape[1] // 2
        if given.ndim > shape + 1:
            some = given[:: max(1, self._count // _SAMPLED)]
            references = leading[name][1]
            width = references.compare(some, self._standardised, self._sweep).width
            reach = COLUMNS.index(width) - COLUMNS.index(0)
            queries = given[:, middle - reach : middle + reach + 1]
        total, counted = sums(queries.flatten(0, -1 - shape) if queries.ndim > 1 else queries)
        if not (self._standardised and self._count >= MIN_FRAMES):
            total, counted = np.zeros_like(total), 1
        return _Swept(queries, torch.from_numpy(total / max(1, counted)).float(), width)

    def _weighed(self, leading: Mapping[str, tuple[Tensor, References]]) -> dict[str, float]:
        """The weights of the channels by their leads, see `fusion.FusedScores`."""
        leads = dict.fromkeys(self._channels, 0.0)
        if self._count >= MIN_FRAMES and len(leads) > 1:
            some = range(0, self._count, max(1, self._count // _SAMPLED))
            for name, (rows, references) in leading.items():
                near = nearness(self._scores(name, some, rows, references))
                deviations = [moments(self._sampled[name][query])[1] for query in some]
                ahead = lead(near) / torch.tensor(deviations).clamp(min=MIN_SPREAD)
                leads[name] = float(ahead.nan_to_num(0, 0, 0).mean())
        return weights_of(leads, {name: each.trust for name, each in self._channels.items()})

    def _scanned(self, some: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The coarse scores ``(B, R)`` of some queries by each channel to all rows as they are
        stored; keeps their candidates."""
        coarse = {
            name: self._large.index.scan(name, [*each[some]], self._sweep)
            for name, each in given.items()
        }
        if not self._everywhere:
            may = self._may(some, self._large.natural)
            coarse = {name: each.masked_fill_(~may, -torch.inf) for name, each in coarse.items()}
        for place, query in enumerate(some.tolist()):
            together = self._large.linear({name: each[place] for name, each in coarse.items()})
            best = together.topk(min(CANDIDATES, len(together)))
            rows = self._large.natural[best.indices[best.values > -torch.inf]]
            self._candidates[query] = rows.sort().values
        return coarse

    def _window(self, some: range, rows: Tensor) -> _Window:
        """The scores of some queries to rising rows."""
        parts = {name: self._scores(name, some, rows) for name in self._channels}
        scores = torch.stack(
            [
                self._fused(
                    [
                        torch.cat((self._sampled[name][query], part[number]))
                        for name, part in parts.items()
                    ]
                )[len(self._rows.sample) :]
                for number, query in enumerate(some)
            ]
        )
        return _Window(rows, scores)

    def _scores(
        self, name: str, some: range, rows: Tensor, references: References | None = None
    ) -> Tensor:
        """``(W, N)`` exact scores of some queries to rising rows by one channel."""
        if references is None:
            references = self._rows.references(self._channels[name], rows, self._standardised)
        drive, part = self._drive[name], slice(some.start, some.stop, some.step)
        excluded = None if self._everywhere else ~self._may(torch.tensor([*some]), rows)
        compared = references.compare(
            drive.queries[part], self._standardised, self._sweep, excluded, drive.mean
        )
        scores: Tensor = compared.whole()
        return scores

    def _fused(self, parts: Sequence[Tensor]) -> Tensor:
        """The scores of one query by all channels as one, to rows of which the sample is first."""
        if len(parts) == 1:
            return parts[0]
        return fused(parts, [*self._share.values()], len(self._rows.sample))

    def _may(self, queries: Tensor, rows: Tensor) -> Tensor:
        """``(W, N)`` bool, which rows may be candidates of which queries."""
        first, last = self._own[queries].T[:, :, None]
        may: Tensor = self._where[rows] & ((rows < first) | (rows >= last))
        return may

    def _around(self, rows: Tensor, reach: int) -> Tensor:
        """The rows and those beside them, rising, each once."""
        near = np.unique(rows[:, None].numpy() + np.arange(-reach, reach + 1))
        return torch.from_numpy(near[(near >= 0) & (near < len(self._where))])


def recognise_drives(
    large: LargeMap,
    queries: FrameSet,
    steps: Steps,
    top: int,
    where: npt.NDArray[np.bool_],
    exclude: int | None = None,
) -> Recognised:
    """The candidates of drives of queries among the rows ``where`` ``(R,)`` bool of a large map;
    ``exclude`` as for `exact.search`."""
    own = np.zeros((len(queries), 2), np.int64)
    if exclude is not None:
        own = neighbours(queries.frames, large.frames, exclude)
    rows = MapRows(large)

    def search(run: range, standardised: bool) -> DriveSearch:
        part = slice(run.start, run.stop)
        descriptors = {name: values[part] for name, values in queries.channels.items()}
        return DriveSearch(
            large, rows, descriptors, standardised, steps.sweep, where, own[part]
        )

    return recognise_by_search(search, queries.sequences, large.frames.sequences, steps, top)
