"""The decision core, ``ssrvlad_decide.h``, on arrays: from the scores of a drive to places.

It needs NumPy and the compiled core, and nothing else of the package. `recognition.reference` says
the same plainly.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from . import required
from .headers import struct

Floats = npt.NDArray[np.floating[Any]]
Rows = npt.NDArray[np.int64]

MODES = {None: 0, "online": 1, "offline": 2}
HIGHEST = 1.001
"""The highest cosine that rounding can give."""

_WRONG_ARGUMENT, _RAISED = -2, -100


@runtime_checkable
class Scores(Protocol):
    """The scores of queries, computed on demand: ``scores[query]`` is an array ``(R,)`` float, one
    for each row of a map. An array ``(Q, R)`` is one."""

    def __len__(self) -> int: ...

    def __getitem__(self, query: int, /) -> Any: ...


@runtime_checkable
class Search(Protocol):
    """Finds candidates for queries in a map that is too large to score every row, and scores any
    row. What it returns are arrays, or what NumPy makes arrays of."""

    def __len__(self) -> int:
        """Number of queries."""

    def candidates(self, query: int) -> Any:
        """``(K,)`` int64, rows of the map in any order, each once."""

    def scores(self, query: int, rows: Rows, /) -> Any:
        """``(N,)`` float32 cosines of rows, rising, -inf where there can be no match."""

    def spread(self, query: int) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of all rows, ``-log(1 - score)``."""

    def sample(self, query: int) -> tuple[Any, Any]:
        """``(M,)`` int64 rows that represent all rows, the same for each query, and their scores,
        -inf where there can be no match: the same part of all rows is taken to match."""


class Decision(NamedTuple):
    """What is decided of the queries of one drive.

    Attributes:
        scores: ``(Q, top)`` float32, of the candidates; -inf for none. Probabilities of rows if the
            drive is followed, of the first candidate with the rows beside it; else their scores.
        rows: ``(Q, top)`` int64; -1 for none.
        right, spread, together: ``(Q,)`` float32, the probability that the first candidate is
            right, its standard deviation, and how many neighbouring queries err together.
        followed: whether the drive is followed.
        way, rate, streams: the course that was taken, or would have been: the way, the rate in rows
            of the map a frame, the number of streams whose frames alternate.
        gain: of the course, a query; 0 if there is none.
    """

    scores: Floats
    rows: Rows
    right: Floats
    spread: Floats
    together: Floats
    followed: bool
    way: int
    rate: float
    streams: int
    gain: float


class Places(NamedTuple):
    """Where the queries of a drive are that is followed.

    Attributes:
        scores, rows: ``(Q, top)`` as of `Decision`, but all scores are those of the row alone.
        near: ``(Q,)`` float32, the probability of the first candidate with the rows beside it.
        unmapped: ``(Q,)`` float32, the probability of a place that the map lacks.
        chance: ``(Q,)`` float64, of `chance` for the first candidate.
    """

    scores: Floats
    rows: Rows
    near: Floats
    unmapped: Floats
    chance: npt.NDArray[np.float64]


def decide(
    evidence: Scores | Search,
    starts: Sequence[int],
    rows: int,
    mode: str | None = "offline",
    delay: int = 0,
    top: int = 5,
    queries: range | None = None,
) -> Decision:
    """The decision about one drive by its scores, or by a search of candidates.

    Args:
        evidence: the queries of the drive, and how they fit a map; scores are cosines, at most 1,
            -inf where there can be no match.
        starts: the first row of each drive of the map, rising from 0.
        rows: the number of rows of the map.
        mode: follow the drive ``"online"``, by the queries before each and ``delay`` later ones, or
            ``"offline"``, by all; ``None`` judges each query alone.
        top: number of candidates of each query.
        queries: the numbers of the queries of the drive; without, all.

    Raises:
        ValueError: scores are NaN or above 1, or another argument is out of range.
        RuntimeError: the core is not there.
        MemoryError: memory is short.
    """
    caller = _Caller(evidence, queries, starts, rows)
    room = Room(caller.count, top)
    caller.call("ssrvlad_decide", MODES[mode], delay, top, room.pointer)
    return room.decision()


def follow(
    evidence: Scores | Search,
    starts: Sequence[int],
    rows: int,
    mode: str = "offline",
    delay: int = 0,
    top: int = 5,
    motion: Sequence[float] | None = None,
    way: int = 1,
    queries: range | None = None,
) -> Places:
    """The places of a drive that is followed, as for `decide`, in a way, 1 for forwards or -1, and
    by a motion: the seven numbers of ``ssrvlad_motion``, by default its own."""
    caller, found = _Caller(evidence, queries, starts, rows), struct("places")()
    near, unmapped = np.empty((2, caller.count), np.float32)
    matches = _matches(caller.count, top)
    places = Places(*matches, near, unmapped, np.empty(caller.count))
    for name, array in zip(_WHERE, places, strict=True):
        setattr(found, name, array.ctypes.data)
    given = _motion(motion), way, MODES[mode], delay, top
    caller.call("ssrvlad_follow", *given, ctypes.byref(found))
    return places


def gain(
    evidence: Scores | Search,
    starts: Sequence[int],
    rows: int,
    motion: Sequence[float] | None = None,
    way: int = 1,
) -> float:
    """How much likelier the queries are as a drive that runs the map in a way than each alone, as a
    natural logarithm; arguments as for `follow`."""
    found, caller = ctypes.c_double(), _Caller(evidence, None, starts, rows)
    caller.call("ssrvlad_gain", _motion(motion), way, ctypes.byref(found))
    return found.value


_ARRAYS = "scores", "rows", "right", "spread", "together"


class Room:
    """Memory for a decision about so many queries; ``pointer`` is what the core fills."""

    def __init__(self, queries: int, top: int) -> None:
        self._matches, self._sure = _matches(queries, top), np.empty((3, queries), np.float32)
        self._found = struct("decision")()
        for name, array in zip(_ARRAYS, (*self._matches, *self._sure), strict=True):
            setattr(self._found, name, array.ctypes.data)
        self.pointer = ctypes.byref(self._found)

    def decision(self) -> Decision:
        """What the core has filled."""
        found, (right, spread, together) = self._found, self._sure
        course = bool(found.followed), found.way, found.rate, found.streams, found.gain
        return Decision(*self._matches, right, spread, together, *course)


def _matches(queries: int, top: int) -> tuple[Floats, Rows]:
    """Memory for candidates."""
    return np.empty((queries, top), np.float32), np.empty((queries, top), np.int64)


_WHERE = "scores", "rows", "around", "unmapped", "chance"


class _Caller:
    """Evidence and a map as the core takes them. What a function of the evidence raises is kept for
    after the call."""

    def __init__(
        self, evidence: Scores | Search, queries: range | None, starts: Sequence[int], rows: int
    ) -> None:
        self._evidence, self._rows, self._raised = evidence, rows, list[BaseException]()
        self._queries = range(len(evidence)) if queries is None else queries
        self.count = len(self._queries)
        self._starts = np.ascontiguousarray(starts, np.int64)
        self._drives = struct("drives")(self._starts.ctypes.data, self._starts.size, rows)
        self._given = struct("evidence")(self.count)
        if isinstance(evidence, np.ndarray):
            part = slice(self._queries.start, self._queries.stop, self._queries.step)
            self._matrix = np.ascontiguousarray(evidence[part], np.float32)
            self._expect(self._matrix, (self.count, rows))
            self._given.matrix = self._matrix.ctypes.data
            return
        functions = {"scores": self._score}
        if isinstance(evidence, Search):
            functions = _of_search(evidence, rows)
        for name, function in functions.items():
            kind = dict(self._given._fields_)[name]
            setattr(self._given, name, kind(self._guarded(function)))

    def call(self, name: str, *arguments: Any) -> None:
        """Calls a function of the core."""
        function = getattr(required(), name)
        status = function(ctypes.byref(self._drives), ctypes.byref(self._given), *arguments)
        for error in self._raised:
            raise error
        if status == _WRONG_ARGUMENT and not isinstance(self._evidence, Search):
            for query in self._queries:
                scores = np.asarray(self._evidence[query], np.float32)
                if scores.size and not (most := float(scores.max())) <= HIGHEST:
                    raise ValueError(f"expected scores of at most 1, as cosines are, got {most:g}")
        if status:
            got = ", ".join(map(str, self._starts[:9])) or "none"
            drives = f"rising starts of drives among {self._rows} rows, from 0, got {got}"
            raise problem(status, drives)

    def _guarded(self, function: Callable[..., int]) -> Callable[..., int]:
        def called(_context: object, query: int, *arguments: Any) -> int:
            try:
                return function(self._queries[query], *arguments)
            except BaseException as error:
                self._raised.append(error)
                return _RAISED

        return called

    def _score(self, query: int, target: int) -> int:
        assert isinstance(self._evidence, Scores)
        found = np.ascontiguousarray(self._evidence[query], np.float32)
        self._expect(found, (self._rows,))
        return _fill(target, found)

    def _expect(self, scores: npt.NDArray[Any], shape: tuple[int, ...]) -> None:
        if scores.shape != shape:
            raise ValueError(f"expected a score for each of {self._rows} rows, got {scores.shape}")


def _of_search(search: Search, count: int) -> dict[str, Callable[..., int]]:
    """The functions of a search as the core calls them."""
    sampled: dict[str, Any] = {}

    def candidates(query: int, target: int | None) -> int:
        found = np.ascontiguousarray(search.candidates(query), np.int64)
        if bad := found[(found < 0) | (found >= count)].tolist():
            raise ValueError(f"expected candidates among {count} rows, got row {bad[0]}")
        return _fill(target, found) or len(found)

    def some(query: int, rows: int, count: int, target: int) -> int:
        given = np.empty(count, np.int64)
        ctypes.memmove(given.ctypes.data, rows, given.nbytes)
        return _fill(target, np.ascontiguousarray(search.scores(query, given), np.float32))

    def spread(query: int, mean: int, deviation: int) -> int:
        for target, value in zip((mean, deviation), search.spread(query), strict=True):
            _fill(target, np.array(value, np.float64))
        return 0

    def sample(query: int, rows: int | None, scores: int | None) -> int:
        found, told = search.sample(query)
        if not np.array_equal(found, sampled.setdefault("rows", found)):
            raise ValueError(f"expected the same sample of rows for each query, not for {query}")
        _fill(rows, np.ascontiguousarray(found, np.int64))
        return _fill(scores, np.ascontiguousarray(told, np.float32)) or len(found)

    return {"candidates": candidates, "some": some, "spread": spread, "sample": sample}


def _fill(target: int | None, values: npt.NDArray[Any]) -> int:
    if target:
        ctypes.memmove(target, values.ctypes.data, values.nbytes)
    return 0


def problem(status: int, expected: str) -> Exception:
    """What to raise for a return code of the core."""
    if status == _WRONG_ARGUMENT:
        return ValueError(f"expected {expected}")
    return MemoryError("the decision core")


def _motion(motion: Sequence[float] | None) -> Any:
    return None if motion is None else ctypes.byref(struct("motion")(*motion))
