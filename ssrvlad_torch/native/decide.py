"""The decision core, ``ssrvlad_decide.h``, on arrays: from the scores of a drive to places.

It needs NumPy and the compiled core, and nothing else of the package. `recognition.reference` says
the same plainly.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from . import core

Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]

MODES = {None: 0, "online": 1, "offline": 2}
HIGHEST = 1.001
"""The highest cosine that rounding can give."""

_SIZE, _POINTER, _NUMBER, _INT = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double, ctypes.c_int
_NUMBERS = ctypes.POINTER(_NUMBER)
_WRONG_ARGUMENT, _RAISED = -2, -100


class Scores(Protocol):
    """The scores of the queries of one drive: ``scores[query]`` is ``(R,)`` float, one for each row
    of a map. An array ``(Q, R)`` is one."""

    def __len__(self) -> int: ...

    def __getitem__(self, query: int, /) -> Any: ...


class Search(Protocol):
    """Finds candidates for the queries of one drive in a map that is too large to score every row,
    and scores any row."""

    def __len__(self) -> int:
        """Number of queries."""

    def candidates(self, query: int) -> Rows:
        """``(K,)`` int64, rows of the map in any order, each once."""

    def scores(self, query: int, rows: Rows) -> Floats:
        """``(N,)`` float32 cosines of rows, -inf where there can be no match."""

    def spread(self, query: int) -> tuple[float, float]:
        """Mean and standard deviation of the nearness of all rows, ``-log(1 - score)``."""

    def sample(self, query: int) -> tuple[Rows, Floats]:
        """``(M,)`` int64 rows that represent all rows, and their scores."""


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

    Raises:
        ValueError: scores are NaN or above 1, or another argument is out of range.
        RuntimeError: the core is not there, or memory is short.
    """
    room = Room(len(evidence), top)
    _call("ssrvlad_decide", evidence, starts, rows, MODES[mode], delay, top, room.pointer)
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
) -> Places:
    """The places of a drive that is followed, as for `decide`, in a way, 1 for forwards or -1, and
    by a motion: the seven numbers of ``ssrvlad_motion``, by default its own."""
    queries, found = len(evidence), _Places()
    scores, indices = np.empty((queries, top), np.float32), np.empty((queries, top), np.int64)
    near, unmapped = np.empty((2, queries), np.float32)
    places = Places(scores, indices, near, unmapped, np.empty(queries))
    for (name, _), array in zip(_Places._fields_, places, strict=True):
        setattr(found, name, array.ctypes.data)
    given = _motion(motion), way, MODES[mode], delay, top
    _call("ssrvlad_follow", evidence, starts, rows, *given, ctypes.byref(found))
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
    found = _NUMBER()
    _call("ssrvlad_gain", evidence, starts, rows, _motion(motion), way, ctypes.byref(found))
    return found.value


def chance(
    values: npt.ArrayLike, rows: npt.ArrayLike | None = None, matching: int | None = None
) -> tuple[float, int]:
    """The probability that a wrong answer is as far ahead of its rivals as the best of values
    ``(N,)`` is, -inf where there is none, and the row of the best rival, -1 without one. ``rows``
    ``(N,)`` are those of the map, rising, by default the first ones; ``matching`` is the number of
    rows that could match, by default of those with a value."""
    numbers, found, rival = np.ascontiguousarray(values, np.float64), _NUMBER(), _SIZE()
    some = None if rows is None else np.ascontiguousarray(rows, np.int64)
    status = library().ssrvlad_chance(
        numbers.ctypes.data,
        None if some is None else some.ctypes.data,
        numbers.size,
        -1 if matching is None else matching,
        ctypes.byref(found),
        ctypes.byref(rival),
    )
    if status:
        raise problem(status, "rows that rise")
    return found.value, rival.value


def confidence(chances: npt.ArrayLike, together: float) -> tuple[Floats, Floats]:
    """``(Q,)`` float32 each, the probability that an answer is right and its standard deviation, by
    the chances of the answers of a drive, NaN without one; so many neighbouring queries err
    together."""
    numbers = np.ascontiguousarray(chances, np.float64)
    right, spread = np.empty((2, numbers.size), np.float32)
    status = library().ssrvlad_confidence(
        numbers.ctypes.data, numbers.size, together, right.ctypes.data, spread.ctypes.data
    )
    if status:
        raise problem(status, f"a number of queries above 0 that err together, got {together}")
    return right, spread


def answers_together(rivals: npt.ArrayLike) -> float:
    """How many neighbouring queries of a drive have one answer, by the best rivals ``(Q,)`` of
    their answers."""
    rows = np.ascontiguousarray(rivals, np.int64)
    found = float(library().ssrvlad_together(rows.ctypes.data, rows.size))
    if found < 0:
        raise problem(-1, "")
    return found


class Drives(ctypes.Structure):
    """``ssrvlad_drives`` of ssrvlad_decide.h."""

    _fields_ = (("starts", _POINTER), ("count", _SIZE), ("rows", _SIZE))


_FUNCTIONS: dict[str, Any] = {
    "scores": ctypes.CFUNCTYPE(_INT, _POINTER, _SIZE, _POINTER),
    "candidates": ctypes.CFUNCTYPE(_SIZE, _POINTER, _SIZE, _POINTER),
    "some": ctypes.CFUNCTYPE(_INT, _POINTER, _SIZE, _POINTER, _SIZE, _POINTER),
    "spread": ctypes.CFUNCTYPE(_INT, _POINTER, _SIZE, _NUMBERS, _NUMBERS),
    "sample": ctypes.CFUNCTYPE(_SIZE, _POINTER, _SIZE, _POINTER, _POINTER),
}


class _Evidence(ctypes.Structure):
    """``ssrvlad_evidence``."""

    _fields_ = (
        *(("queries", _SIZE), ("matrix", _POINTER), ("context", _POINTER)),
        *_FUNCTIONS.items(),
    )


class _Decision(ctypes.Structure):
    """``ssrvlad_decision``."""

    _fields_ = (
        *((name, _POINTER) for name in ("scores", "rows", "right", "spread", "together")),
        *(("followed", ctypes.c_int32), ("way", ctypes.c_int32), ("streams", _SIZE)),
        *(("rate", _NUMBER), ("gain", _NUMBER)),
    )


class Room:
    """Memory for the decision about so many queries; ``pointer`` is what the core fills."""

    def __init__(self, queries: int, top: int) -> None:
        scores, rows = np.empty((queries, top), np.float32), np.empty((queries, top), np.int64)
        self._arrays, self._found = (scores, rows, *np.empty((3, queries), np.float32)), _Decision()
        for (name, _), array in zip(_Decision._fields_, self._arrays, strict=False):
            setattr(self._found, name, array.ctypes.data)
        self.pointer = ctypes.byref(self._found)

    def decision(self) -> Decision:
        """What was filled."""
        found = self._found
        course = bool(found.followed), found.way, found.rate, found.streams, found.gain
        return Decision(*self._arrays, *course)


class _Places(ctypes.Structure):
    """``ssrvlad_places``."""

    _fields_ = tuple(
        (name, _POINTER) for name in ("scores", "rows", "around", "unmapped", "chance")
    )


class _Motion(ctypes.Structure):
    """``ssrvlad_motion``."""

    _fields_ = tuple(
        (name, _NUMBER)
        for name in ("change", "jump", "unmapped", "stay", "weight", "level", "rate")
    )


class _Caller:
    """The evidence as the core takes it. What its functions raise is kept for after the call."""

    def __init__(self, evidence: Scores | Search, rows: int) -> None:
        self.raised: BaseException | None = None
        self.given = _Evidence(len(evidence))
        self._evidence, self._rows = evidence, rows
        if isinstance(evidence, np.ndarray):
            self._matrix = np.ascontiguousarray(evidence, np.float32)
            if self._matrix.shape != (len(evidence), rows):
                got = self._matrix.shape
                raise ValueError(f"expected a score for each of {rows} rows, got {got}")
            self.given.matrix = self._matrix.ctypes.data
            return
        searched = ("candidates", "some", "spread", "sample")
        for name in searched if hasattr(evidence, "candidates") else ("scores",):
            function = self._guarded(getattr(self, f"_{name}"))
            setattr(self.given, name, _FUNCTIONS[name](function))

    def _guarded(self, function: Callable[..., int]) -> Callable[..., int]:
        def called(_context: object, *arguments: Any) -> int:
            try:
                return function(*arguments)
            except BaseException as error:
                self.raised = error
                return _RAISED

        return called

    def _scores(self, query: int, target: int) -> int:
        found = np.ascontiguousarray(self._evidence[query], np.float32)  # type: ignore[index]
        if found.shape != (self._rows,):
            raise ValueError(f"expected a score for each of {self._rows} rows, got {found.shape}")
        return _filled(target, found)

    def _candidates(self, query: int, target: int | None) -> int:
        found = np.ascontiguousarray(self._evidence.candidates(query), np.int64)  # type: ignore[union-attr]
        return _filled(target, found) or len(found)

    def _some(self, query: int, rows: int, count: int, target: int) -> int:
        given = np.empty(count, np.int64)
        ctypes.memmove(given.ctypes.data, rows, given.nbytes)
        found = self._evidence.scores(query, given)  # type: ignore[union-attr]
        return _filled(target, np.ascontiguousarray(found, np.float32))

    def _spread(self, query: int, mean: Any, deviation: Any) -> int:
        mean[0], deviation[0] = self._evidence.spread(query)  # type: ignore[union-attr]
        return 0

    def _sample(self, query: int, rows: int | None, scores: int | None) -> int:
        found, told = self._evidence.sample(query)  # type: ignore[union-attr]
        _filled(rows, np.ascontiguousarray(found, np.int64))
        return _filled(scores, np.ascontiguousarray(told, np.float32)) or len(found)


def _filled(target: int | None, values: npt.NDArray[Any]) -> int:
    if target:
        ctypes.memmove(target, values.ctypes.data, values.nbytes)
    return 0


def _call(
    name: str, evidence: Scores | Search, starts: Sequence[int], rows: int, *arguments: Any
) -> None:
    """Calls a function of the core with a map, evidence and other arguments."""
    first = np.ascontiguousarray(starts, np.int64)
    caller = _Caller(evidence, rows)
    drives = Drives(first.ctypes.data, first.size, rows)
    function = getattr(library(), name)
    status = function(ctypes.byref(drives), ctypes.byref(caller.given), *arguments)
    if caller.raised:
        raise caller.raised
    if status == _WRONG_ARGUMENT and not hasattr(evidence, "candidates"):
        for query in range(len(evidence)):
            scores = np.asarray(evidence[query], np.float32)  # type: ignore[index]
            if scores.size and not (highest := float(scores.max())) <= HIGHEST:
                raise ValueError(f"expected scores of at most 1, as cosines are, got {highest:g}")
    if status:
        raise problem(status, f"drives that start at rising rows of {rows}, got {first.tolist()}")


def problem(status: int, expected: str) -> Exception:
    if status == _WRONG_ARGUMENT:
        return ValueError(f"expected {expected}")
    return RuntimeError("not enough memory for the decision core")


def _motion(motion: Sequence[float] | None) -> Any:
    return None if motion is None else ctypes.byref(_Motion(*motion))


@cache
def library() -> ctypes.CDLL:
    """The core, with the types of its functions."""
    library, status = core()
    if library is None:
        raise RuntimeError(f"expected the native core, got {status}")
    map_and_evidence = ctypes.POINTER(Drives), ctypes.POINTER(_Evidence)
    motion, size = ctypes.POINTER(_Motion), _SIZE
    library.ssrvlad_decide.argtypes = [
        *(*map_and_evidence, _INT, size, size, ctypes.POINTER(_Decision))
    ]
    library.ssrvlad_follow.argtypes = [
        *(*map_and_evidence, motion, _INT, _INT, size, size, ctypes.POINTER(_Places))
    ]
    library.ssrvlad_gain.argtypes = [*map_and_evidence, motion, _INT, _NUMBERS]
    sizes = ctypes.POINTER(size)
    library.ssrvlad_chance.argtypes = [_POINTER, _POINTER, size, size, _NUMBERS, sizes]
    library.ssrvlad_confidence.argtypes = [_POINTER, size, _NUMBER, _POINTER, _POINTER]
    library.ssrvlad_together.argtypes = [_POINTER, size]
    library.ssrvlad_together.restype = _NUMBER
    return library
