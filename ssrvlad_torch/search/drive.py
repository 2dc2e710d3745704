"""Drives in a large map: candidates of the coarse index, scored exactly and followed.

Scores are those of exact search but for the spread of a query's scores, the lead of each channel
and the width of the sweep, which are known by a sample of the map and of the queries. A candidate
may be missed.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..database.frames import FrameSet
from ..recognition.comparison import ReferenceRows
from ..recognition.fusion import Scale, fused, lead, moments, weights_of
from ..recognition.motion import ELSEWHERE
from ..recognition.recognise import Recognised, Steps, judged_alone, recognise_by_search
from ..recognition.standardise import MIN_FRAMES
from ..recognition.sweep import COLUMNS
from .alone import AloneSearch, LargeMap
from .map_rows import MapRows
from .selection import neighbours
from .sums import sums

CANDIDATES, BEST, EVERY = 40, 8, 4
"""Rows by the fused coarse scores of a query, whatever it follows. Of a long drive that is
followed, every fourth query is compared with all rows, of a shorter one more. The others have the
candidates of the queries before and after, and the rows beside the best of these: docs/scale.md."""

_SAMPLED, _LEADING = 32, 10
"""Least number of queries, if there are as many, by which the width of a sweep and the lead of a
channel are known, and how many rows that are best by its coarse scores."""

_SCANNED, _WINDOW, _AROUND, _AHEAD = 8, 32, 2, 24
"""Queries that are compared with all rows at once, and that are scored at once; rows to each side
of a candidate, and of a row to which a drive may have moved, that are scored with it: the next
queries will ask for them."""


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
    `native.decide.Search`. It keeps all scores, 10 to 30 kB a query.

    Args:
        rows: of the map.
        descriptors: of the queries by channel, from all anchors if they are swept.
        standardised: subtract the mean of each drive.
        sweep: as wide as suits the scores.
        followed: not each query alone.
        top: the number of candidates that are wanted.
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
        followed: bool,
        top: int,
        where: npt.NDArray[np.bool_],
        own: npt.NDArray[np.int64],
    ) -> None:
        self._large, self._rows, self._standardised = large, rows, standardised
        self._most = max(CANDIDATES, top)
        self._sweep, self._own = sweep, torch.from_numpy(own)
        self._where = torch.from_numpy(where)
        self._everywhere = bool(where.all()) and bool((own[:, 0] >= own[:, 1]).all())
        self._channels = {channel.column.name: channel for channel in large.channels}
        given = {name: descriptors[name] for name in self._channels}
        self._count = len(next(iter(given.values())))
        sampled_every = max(1, self._count // _SAMPLED)
        self._step = min(EVERY, sampled_every) if followed else 1  # so that the sample is scanned
        self._some = range(0, self._count, sampled_every - sampled_every % self._step)
        self._candidates: dict[int, Tensor] = {}
        self._windows: dict[int, _Window] = {}
        leading = self._leading(given)
        self._drive = {name: self._swept(name, each, leading) for name, each in given.items()}
        self.width = max(each.width for each in self._drive.values())
        every = range(self._count)
        allowed = rows.sample(where)
        sampled = {name: self._scores(name, every, allowed) for name in given}
        self._scales = {name: Scale.of(each) for name, each in sampled.items()}
        self._share = self._weighed(leading)
        self.weights = self._share if len(self._share) > 1 else {}
        self._sample_rows, self._sample = allowed, self._fused(sampled, slice(None))
        self._spread = [moments(each) for each in self._sample]
        if not where.all():
            self._sample_rows = rows.sample(np.ones_like(where))
            sampled = {name: self._scores(name, every, self._sample_rows) for name in given}
            self._sample = self._fused(sampled, slice(None))

    def __len__(self) -> int:
        return self._count

    def candidates(self, query: int) -> Tensor:
        """See `native.decide.Search`."""
        before = query - query % self._step
        found = [self._scan(before)]
        if query > before:
            found.append(self._scan(min(before + self._step, self._count - 1)))
            found += [self._around(each[:BEST], self._step - 1) for each in found]
        return torch.from_numpy(np.unique(torch.cat(found).numpy()))

    def _scan(self, query: int) -> Tensor:
        """The candidates of one of the queries that are scanned, best first."""
        if query not in self._candidates:
            some = [*range(query, self._count, self._step), self._count - 1]
            missing = [each for each in dict.fromkeys(some) if each not in self._candidates]
            drive = {name: each.queries for name, each in self._drive.items()}
            self._scanned(torch.tensor(missing[:_SCANNED]), drive)
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
        return self._sample_rows, self._sample[query]

    def _leading(self, given: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, ReferenceRows]]:
        """By each channel: some of the queries, and the rows that are nearest to them by the coarse
        scores, with those beside them."""
        nearest: dict[str, list[Tensor]] = {name: [] for name in given}
        for part in torch.tensor(self._some).split(_SCANNED):
            for name, rows in self._scanned(part, given).items():
                nearest[name].append(rows)
        leading = {}
        for name, each in nearest.items():
            rows = self._around(torch.cat(each), ELSEWHERE)
            references = self._rows.references(self._channels[name], rows, self._standardised)
            leading[name] = rows, references
        return leading

    def _swept(
        self, name: str, given: Tensor, leading: Mapping[str, tuple[Tensor, ReferenceRows]]
    ) -> _Swept:
        """The queries as wide as suits the rows that are nearest to them."""
        shape = len(self._channels[name].column.shape)
        width, queries, middle = 0, given, given.shape[1] // 2
        if given.ndim > shape + 1:
            some, references = given[:: self._some.step], leading[name][1]
            width = references.compare(some, self._standardised, self._sweep).width
            reach = COLUMNS.index(width) - COLUMNS.index(0)
            queries = given[:, middle - reach : middle + reach + 1]
        total, counted = sums(queries.flatten(0, -1 - shape))
        if not (self._standardised and self._count >= MIN_FRAMES):
            total, counted = np.zeros_like(total), 1
        return _Swept(queries, torch.from_numpy(total / max(1, counted)).float(), width)

    def _weighed(self, leading: Mapping[str, tuple[Tensor, ReferenceRows]]) -> dict[str, float]:
        """The weights of the channels by their leads, see `fusion.FusedScores`."""
        leads = dict.fromkeys(self._channels, 0.0)
        if self._count >= MIN_FRAMES and len(leads) > 1:
            for name, (rows, references) in leading.items():
                scale = Scale(*(of[:: self._some.step] for of in self._scales[name]))
                z = scale.z(self._scores(name, self._some, rows, references))
                leads[name] = float(lead(z).nan_to_num(0, 0, 0).mean())
        return weights_of(leads, {name: each.trust for name, each in self._channels.items()})

    def _scanned(self, some: Tensor, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The rows that are nearest to some queries by the coarse scores of each channel to all
        rows; keeps the candidates of these queries."""
        natural, nearest = self._large.natural, dict[str, Tensor]()
        never = None if self._everywhere else ~self._may(some, natural)
        together = torch.zeros(len(some), len(natural))
        for name, each in given.items():
            coarse = self._large.index.scan(name, [*each[some]], self._sweep)
            for of_query, scores in zip(together, coarse, strict=True):
                of_query.add_(scores, alpha=self._large.factor(name, scores))
            if never is not None:
                coarse.masked_fill_(never, -torch.inf)
            best = coarse.topk(min(_LEADING, len(natural))).indices
            nearest[name] = natural[best.flatten()]
        if never is not None:
            together.masked_fill_(never, -torch.inf)
        for query, scores in zip(some.tolist(), together, strict=True):
            best = scores.topk(min(self._most, len(scores)))
            self._candidates[query] = natural[best.indices[best.values > -torch.inf]]
        return nearest

    def _window(self, some: range, rows: Tensor) -> _Window:
        """The scores of some queries to rising rows."""
        parts = {name: self._scores(name, some, rows) for name in self._channels}
        return _Window(rows, self._fused(parts, slice(some.start, some.stop)))

    def _scores(
        self, name: str, some: range, rows: Tensor, references: ReferenceRows | None = None
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

    def _fused(self, parts: Mapping[str, Tensor], queries: slice) -> Tensor:
        """``(W, N)`` scores of some queries by all channels as one, by those of each."""
        if len(parts) == 1:
            return next(iter(parts.values()))
        scales = [Scale(*(of[queries] for of in self._scales[name])) for name in parts]
        return fused([*parts.values()], [self._share[name] for name in parts], scales)

    def _may(self, queries: Tensor, rows: Tensor) -> Tensor:
        """``(W, N)`` bool, which rows may be candidates of which queries."""
        first, last = self._own[queries].T[:, :, None]
        may: Tensor = self._where[rows] & ((rows < first) | (rows >= last))
        return may

    def _around(self, rows: Tensor, reach: int) -> Tensor:
        """The rows and those beside them, rising, each once."""
        near = np.unique(rows[:, None].numpy() + np.arange(-reach, reach + 1))
        return torch.from_numpy(near[(near >= 0) & (near < len(self._where))])


def recognise_in_large(
    large: LargeMap,
    queries: FrameSet,
    steps: Steps,
    top: int,
    where: npt.NDArray[np.bool_],
    exclude: int | None = None,
) -> Recognised:
    """The candidates of queries among the rows ``where`` ``(R,)`` bool of a large map; ``exclude``
    as for `exact.search`."""
    own, rows = neighbours(queries.frames, large.frames, exclude), MapRows(large)
    alone = judged_alone(queries.sequences, steps)

    def search(run: range, standardised: bool) -> AloneSearch | DriveSearch:
        part = slice(run.start, run.stop)
        descriptors = {name: values[part] for name, values in queries.channels.items()}
        if alone:
            return AloneSearch(large, descriptors, steps.sweep, top, where, own[part])
        given = descriptors, standardised, steps.sweep, bool(steps.follow), top, where, own[part]
        return DriveSearch(large, rows, *given)

    return recognise_by_search(search, queries.sequences, large.frames.sequences, steps, top)
