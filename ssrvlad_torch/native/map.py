"""The map of the core, ``ssrvlad_map.h``, on arrays: from descriptors of a map and of a sequence of
queries to places.

It needs NumPy and the compiled core, and nothing else of the package.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import failure, require, required
from .addresses import address
from .headers import number, struct

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.floating[Any]]
Rows = npt.NDArray[np.int64]

MODES = {None: 0, "online": 1, "offline": 2}

_VECTORS, _SIGNS, _SCORES = 0, 1, 2


class Taken(NamedTuple):
    """The steps that were taken.

    Attributes:
        standardised: whether each sequence lost the mean of its descriptors.
        width: of the sweep, in anchors to each side.
        weights: of the channels, by their names; their sum is 1.
    """

    standardised: bool
    width: int
    weights: dict[str, float]


class Decision(NamedTuple):
    """What is decided of the queries of one sequence.

    Attributes:
        scores: ``(Q, top)`` float32, of the candidates; -inf for none. Probabilities of rows if the
            query is followed, of the first candidate with the rows beside it; else their scores.
        rows: ``(Q, top)`` int64; -1 for none.
        right, spread, together: ``(Q,)`` float32, the probability that the first candidate is
            right, its standard deviation, and how many neighbouring queries err together.
        follows: ``(Q,)`` bool, whether each query is followed; online that depends on the queries
            before it.
        way, rate, streams: the course that was taken, or would have been: the way, the rate in rows
            of the map a frame, the number of streams whose frames alternate.
        gain: of the course, a query; 0 if there is none.
        taken: the steps before.
    """

    scores: Floats
    rows: Rows
    right: Floats
    spread: Floats
    together: Floats
    follows: npt.NDArray[np.bool_]
    way: int
    rate: float
    streams: int
    gain: float
    taken: Taken

    @property
    def followed(self) -> bool:
        """Whether any query is followed."""
        return bool(self.follows.any())


class Shortlist(NamedTuple):
    """Some rows of a map that stand for all: likely candidates and a random sample of the others.

    Attributes:
        rows: ``(N,)`` int64, rising.
        weights: ``(N,)`` float64, how many rows of the map each stands for, from 1.
        means: ``(M,)`` int64, the first places, rising from 0, of adjacent rows that lose one mean.
    """

    rows: Rows
    weights: npt.NDArray[np.float64]
    means: Rows


class DescriptorMap:
    """The rows of a map by one or several channels.

    Attributes:
        frames: the number of frames of the map.
        channels: the rows of each channel by its name, ``None`` of scores.

    Args:
        frames: the number of frames of each sequence of the map, in its order.
        shortlist: the rows that are there, if not all.

    Raises:
        ValueError: a sequence has no frame, or the rows of the shortlist do not rise.
        RuntimeError: the core is not there.
        MemoryError: memory is short.

    Examples:
        >>> import numpy as np
        >>> from ssrvlad_torch.native.map import DescriptorMap
        >>> frames = np.eye(40, dtype=np.float32)
        >>> town = DescriptorMap([40])
        >>> town.add("shapes", frames)
        >>> town.query({"shapes": frames[5:9]}).rows[:, 0].tolist()
        [5, 6, 7, 8]
    """

    def __init__(self, frames: Sequence[int], shortlist: Shortlist | None = None) -> None:
        core = required()
        starts = np.cumsum([0, *frames], dtype=np.int64)
        self.frames, self._count, self._means = int(starts[-1]), int(starts[-1]), len(frames)
        drives = struct("drives")(starts.ctypes.data, len(frames), self.frames)
        if shortlist is None:
            self._map = core.ssrvlad_map_new_for(number("INTERFACE"), drives)
        else:
            rows = np.ascontiguousarray(shortlist.rows, np.int64)
            means = np.ascontiguousarray(shortlist.means, np.int64)
            weights = np.ascontiguousarray(shortlist.weights, np.float64)
            self._count, self._means = len(rows), len(means)
            first = address(weights, rows.shape, "float64")
            listed = struct("shortlist")(
                rows.ctypes.data, first, self._count, means.ctypes.data, self._means
            )
            self._map = core.ssrvlad_map_of_for(number("INTERFACE"), drives, listed)
        if not self._map:
            raise failure()
        weakref.finalize(self, core.ssrvlad_map_free, ctypes.c_void_p(self._map))
        self._channels: dict[str, Array | None] = {}
        self.channels = MappingProxyType(self._channels)
        self._of_sequences: list[Array | None] = []

    def __len__(self) -> int:
        """Number of rows that are there."""
        return self._count

    def add(
        self, name: str, rows: Array | None, trust: float = 1.0, means: Array | None = None
    ) -> None:
        """Adds a channel. The rows stay where they are, if they are contiguous.

        Args:
            name: of the channel.
            rows: vectors ``(R, D)`` float32 of length 1 or zero, which match nothing; or signs
                ``(R, columns, rows, bytes)`` uint8, eight in a byte; ``None`` for scores of another
                method.
            trust: how much the channel counts before anything is known of a sequence.
            means: what the rows of a shortlist lose: ``(M, D)`` float32, of signs as 1 and -1 ``(M,
                columns, rows, bits)``.

        Raises:
            ValueError: the rows are no such array, not one for each frame, or not finite.
        """
        new = name not in self.channels
        _expect(name, ", ".join(self.channels), new, "a name that is new")
        array, first, kind, shape = None, None, _SCORES, (1, 1, 1)
        if rows is not None:
            array = _checked(rows, name)
            _expect(
                name,
                len(array),
                len(array) == self._count,
                f"a row for each of {self._count} frames",
            )
            kind = _VECTORS if array.dtype == np.float32 else _SIGNS
            _expect(name, array.shape, kind == _SIGNS or array.ndim == 2, "vectors (R, D)")
            shape = (1, 1, array.shape[1]) if kind == _VECTORS else array.shape[1:]
            first = array.ctypes.data
        of_means = None
        if means is not None:
            means = np.ascontiguousarray(means, np.float32)
            size = self._means * math.prod(shape) * (8 if kind == _SIGNS else 1)
            _expect(
                name, means.shape, means.size == size, f"means of {self._means} parts of the map"
            )
            of_means = means.ctypes.data
        channel = struct("channel")(first, kind, *shape, trust, of_means)
        require(required().ssrvlad_map_add_channel(self._map, channel), name)
        self._channels[name] = array
        self._of_sequences.append(means)

    def query(
        self,
        queries: Mapping[str, Array],
        standardise: bool = True,
        sweep: bool = True,
        follow: str | None = "offline",
        delay: int = 0,
        top: int = 5,
        threads: int = 1,
        allowed: Array | None = None,
        excluded: Array | None = None,
    ) -> Decision:
        """Finds the queries of one sequence.

        Args:
            queries: by the name of each channel of the map, ``(Q, *shape)``; of vectors also from
                several anchors, the usual one in the middle, ``(Q, S, D)``; scores of another
                method ``(Q, R)`` float32, at most 1, -inf where there can be no match.
            standardise: subtract the mean of each sequence, if queries and map have 30 frames.
            sweep: use the anchors that suit the scores best, and move signs to both sides.
            follow: ``"online"``, with ``delay`` later queries, ``"offline"``, or ``None``.
            top: number of candidates of each query.
            threads: that share the rows.
            allowed: ``(R,)`` bool, rows that may be candidates.
            excluded: ``(Q, 2)`` int64, rows of the map that may not be those of a query: the first
                and the one after the last.

        Raises:
            ValueError: the channels are not those of the map, or an argument is out of range.
            MemoryError: memory is short.
        """
        call = Call(self, queries, (standardise, sweep, follow, delay, top), allowed, excluded)
        target = Target(call.count, top, self.channels)
        require(
            required().ssrvlad_map_query(
                *(self._map, call.queries, call.count, call.steps, threads),
                *(target.decision, target.steps),
            )
        )
        return target.decided()

    def compare(
        self,
        queries: Mapping[str, Array],
        standardise: bool = False,
        sweep: bool = False,
        threads: int = 1,
        allowed: Array | None = None,
        excluded: Array | None = None,
    ) -> tuple[Floats, Taken]:
        """The scores ``(Q, R)`` float32 by which `query` decides, of all channels, -inf where there
        can be no match."""
        call = Call(self, queries, (standardise, sweep, None, 0, 1), allowed, excluded)
        scores = np.empty((call.count, self._count), np.float32)
        target = Target(0, 1, self.channels)
        require(
            required().ssrvlad_map_compare(
                *(self._map, call.queries, call.count, call.steps, threads),
                *(scores.ctypes.data, target.steps),
            )
        )
        return scores, target.taken()

    @property
    def address(self) -> int:
        """Of the map in the core."""
        return int(self._map)

    def no_queries(self, name: str) -> Array:
        """An array of no queries of a channel."""
        rows = self.channels[name]
        return np.empty((0, len(self)), np.float32) if rows is None else rows[:0]


class Target:
    """Memory for what the core decides of some queries.

    Attributes:
        decision, steps: for the core, ``ssrvlad_decision`` and ``ssrvlad_taken``.
    """

    def __init__(self, count: int, top: int, channels: Collection[str]) -> None:
        self._arrays: dict[str, Array] = {
            "scores": np.empty((count, top), np.float32),
            "rows": np.empty((count, top), np.int64),
            "right": np.empty(count, np.float32),
            "spread": np.empty(count, np.float32),
            "together": np.empty(count, np.float32),
            "follows": np.empty(count, np.bool_),
        }
        self._channels, self._weights = channels, (ctypes.c_double * len(channels))()
        self.decision = struct("decision")()
        self.steps = struct("taken")(weights=ctypes.addressof(self._weights))
        for name, array in self._arrays.items():
            setattr(self.decision, name, array.ctypes.data)

    def taken(self) -> Taken:
        """The steps that were taken."""
        weights = dict(zip(self._channels, self._weights, strict=True))
        return Taken(bool(self.steps.standardised), self.steps.width, weights)

    def decided(self) -> Decision:
        """The decision."""
        of, (scores, rows, right, spread, together, follows) = self.decision, self._arrays.values()
        course = of.way, of.rate, of.streams, of.gain
        return Decision(scores, rows, right, spread, together, follows, *course, self.taken())


class Call:
    """The queries of one sequence and the steps, as the core takes them.

    Attributes:
        queries, count, steps: for the core, ``ssrvlad_queries`` by each channel, how many there
            are, and ``ssrvlad_steps``.
    """

    def __init__(
        self,
        town: DescriptorMap,
        queries: Mapping[str, Array],
        steps: tuple[bool, bool, str | None, int, int],
        allowed: Array | None,
        excluded: Array | None,
    ) -> None:
        channels = town.channels
        if [*queries] != [*channels] or not queries:
            expected, got = (", ".join(names) or "none" for names in (channels, queries))
            raise ValueError(f"expected queries by {expected}, got {got}")
        standardise, sweep, follow, delay, top = steps
        _expect("follow", follow, follow in MODES, ", ".join(map(str, MODES)))
        _expect("delay", delay, delay >= 0, "at least 0")
        _expect("top", top, top >= 1, "at least 1")
        self._arrays, counts = list[Array | None](), dict[str, int]()  # the core reads them
        self.queries = (struct("queries") * len(channels))()
        for place, (name, rows) in enumerate(channels.items()):
            array, anchors = _queries_of(name, queries[name], rows, len(town))
            self.queries[place] = array.ctypes.data, anchors
            self._arrays.append(array)
            counts[name] = self.count = len(array)
        _expect("queries", counts, len(set(counts.values())) == 1, "one number by all channels")
        self.steps = struct("steps")(standardise, sweep, MODES[follow], delay, top)
        if allowed is not None:
            allowed = _of_shape("allowed", allowed, np.uint8, (len(town),))
            self.steps.allowed = allowed.ctypes.data
        if excluded is not None:
            excluded = _of_shape("excluded", excluded, np.int64, (self.count, 2))
            self.steps.excluded = excluded.ctypes.data
        self._arrays += allowed, excluded


def _queries_of(name: str, queries: Array, rows: Array | None, count: int) -> tuple[Array, int]:
    """Queries of a channel with these rows, or without any as scores of so many, and the number of
    their anchors."""
    if rows is None:
        return _of_shape(name, queries, np.float32, (len(queries), count)), 1
    array = _checked(queries, name)
    swept = rows.dtype == np.float32 and array.ndim > rows.ndim
    fits = array.dtype == rows.dtype and array.shape[1 + swept :] == rows.shape[1:]
    if not fits or (swept and array.shape[1] % 2 == 0):
        expected = ", ".join(map(str, rows.shape[1:]))
        raise ValueError(
            f"{name}: expected queries (Q, {expected}) {rows.dtype}, of vectors also (Q, S, D) "
            f"with an odd S, got {array.shape} {array.dtype}"
        )
    return array, array.shape[1] if swept else 1


def _expect(name: str, got: object, fits: bool, expected: str) -> None:
    if not fits:
        raise ValueError(f"{name}: expected {expected}, got {got!r}")


def _of_shape(name: str, values: Array, kind: type[np.generic], shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(values, kind)
    _expect(name, array.shape, array.shape == shape, f"shape {shape}")
    return array


def _checked(array: Array, name: str) -> Array:
    """Contiguous vectors or signs."""
    numbers = np.asarray(array)
    checked = np.ascontiguousarray(numbers, np.float32 if numbers.dtype.kind == "f" else None)
    are_signs = checked.dtype == np.uint8 and checked.ndim == 4
    if not are_signs and not (checked.dtype == np.float32 and checked.ndim in (2, 3)):
        raise ValueError(
            f"{name}: expected vectors of float32 or signs (N, columns, rows, bytes) of uint8, got "
            f"{checked.shape} {checked.dtype}"
        )
    return checked
