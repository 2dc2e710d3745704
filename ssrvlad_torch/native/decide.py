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
    given, caller = steps_of(mode, delay, top), _Caller(evidence, queries, starts, rows)
    room = Room(caller.count, top)
    caller.call("ssrvlad_decide", *given, room.pointer)
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
    given = _motion(motion), _way(way), *steps_of(mode, delay, top, modes=("online", "offline"))
    caller, found = _Caller(evidence, queries, starts, rows), struct("places")()
    near, unmapped = np.empty((2, caller.count), np.float32)
    matches = _matches(caller.count, top)
    places = Places(*matches, near, unmapped, np.empty(caller.count))
    for name, array in zip(_WHERE, places, strict=True):
        setattr(found, name, array.ctypes.data)
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
    caller.call("ssrvlad_gain", _motion(motion), _way(way), ctypes.byref(found))
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
            self._matrix = _array("scores", evidence[part], np.float32, (self.count, rows))
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
        return _fill(target, _array("scores", self._evidence[query], np.float32, (self._rows,)))


def _of_search(search: Search, count: int) -> dict[str, Callable[..., int]]:
    """The functions of a search as the core calls them."""
    told: dict[str, npt.NDArray[Any]] = {}  # since the core asked for the number of rows

    def candidates(query: int, target: int | None) -> int:
        if target is None:
            found = told["found"] = _array("candidates", search.candidates(query), np.int64)
            if bad := found[(found < 0) | (found >= count)].tolist():
                raise ValueError(f"expected candidates among {count} rows, got row {bad[0]}")
        return _fill(target, told["found"]) or len(told["found"])

    def some(query: int, rows: int, count: int, target: int) -> int:
        given = np.empty(count, np.int64)
        ctypes.memmove(given.ctypes.data, rows, given.nbytes)
        found = search.scores(query, given)
        return _fill(target, _array("scores", found, np.float32, (count,)))

    def spread(query: int, mean: int, deviation: int) -> int:
        found = _array("spread", search.spread(query), np.float64, (2,))
        fits = bool(np.isfinite(found).all() and found[1] >= 0)
        expect("spread", found.tolist(), fits, "a finite mean and a deviation of at least 0")
        return _fill(mean, found[:1]) or _fill(deviation, found[1:])

    def sample(query: int, rows: int | None, scores: int | None) -> int:
        if rows is None:
            some, found = search.sample(query)
            same = _array("sample", some, np.int64)
            if not np.array_equal(same, told.setdefault("rows", same)):
                raise ValueError(
                    f"expected the same sample of rows for each query, not for {query}"
                )
            told["scores"] = _array("sample", found, np.float32, same.shape)
        return _fill(rows, told["rows"]) or _fill(scores, told["scores"]) or len(told["rows"])

    return {"candidates": candidates, "some": some, "spread": spread, "sample": sample}


def _array(
    name: str, values: Any, kind: type[np.generic], shape: tuple[int, ...] | None = None
) -> npt.NDArray[Any]:
    """Evidence as the core reads it, of a shape, by default ``(N,)``; scores are at most 1."""
    found = np.ascontiguousarray(values, kind)
    wanted = (found.size,) if shape is None else shape
    expect(name, found.shape, found.shape == wanted, f"shape {wanted}")
    most = float(found.max(initial=-np.inf)) if kind is np.float32 else 0.0
    expect(name, most, most <= HIGHEST, "scores of at most 1, as cosines are")
    return found


def _fill(target: int | None, values: npt.NDArray[Any]) -> int:
    if target:
        ctypes.memmove(target, values.ctypes.data, values.nbytes)
    return 0


def steps_of(
    mode: str | None, delay: int, top: int, name: str = "mode", modes: Sequence[Any] = (*MODES,)
) -> tuple[int, int, int]:
    """The steps of a decision as the core takes them, checked; ``name`` is that of the mode."""
    expect(name, mode, mode in modes, ", ".join(map(str, modes)))
    expect("delay", delay, delay >= 0, "at least 0")
    expect("top", top, top >= 1, "at least 1")
    return MODES[mode], delay, top


def expect(name: str, got: object, fits: bool, wanted: str) -> None:
    """Raises a ValueError in one line unless an argument fits."""
    if not fits:
        raise ValueError(f"{name}: expected {wanted}, got {got!r}")


def _way(way: int) -> int:
    expect("way", way, way in (1, -1), "1 or -1")
    return way


def problem(status: int, expected: str) -> Exception:
    """What to raise for a return code of the core."""
    if status == _WRONG_ARGUMENT:
        return ValueError(f"expected {expected}")
    return MemoryError("the decision core")


def _motion(motion: Sequence[float] | None) -> Any:
    return None if motion is None else ctypes.byref(struct("motion")(*motion))
