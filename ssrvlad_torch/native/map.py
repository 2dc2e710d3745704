"""The map of the core, ``ssrvlad_map.h``, on arrays: from descriptors of a map and of a drive to
places.

It needs NumPy and the compiled core, and nothing else of the package. `recognition.reference` says
the same plainly.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import required
from .decide import Decision, Floats, Room, problem, steps_of
from .headers import struct

Array = npt.NDArray[Any]

MIN_FRAMES = 30
"""Of a drive that has a mean of its own, and of a map for it."""


class Found(NamedTuple):
    """The places of a drive, and the steps that were taken.

    Attributes:
        decision: candidates, and how sure the first are.
        standardised: whether each drive lost the mean of its descriptors.
        width: of the sweep, in anchors to each side.
        weights: of the channels, by their names; their sum is 1.
    """

    decision: Decision
    standardised: bool
    width: int
    weights: dict[str, float]


class Map:
    """The rows of a map by one or several channels.

    Args:
        frames: the number of frames of each drive of the map, in its order.

    Raises:
        ValueError: a drive has no frame.
        RuntimeError: the core is not there, or memory is short.

    Examples:
        >>> import numpy as np
        >>> from ssrvlad_torch.native.map import Map
        >>> frames = np.eye(40, dtype=np.float32)
        >>> town = Map([40])
        >>> town.add("shapes", frames)
        >>> town.query({"shapes": frames[5:9]}).decision.rows[:, 0].tolist()
        [5, 6, 7, 8]
    """

    def __init__(self, frames: Sequence[int]) -> None:
        core = required()
        starts = np.cumsum([0, *frames], dtype=np.int64)
        drives = struct("drives")(starts.ctypes.data, len(frames), int(starts[-1]))
        self._map = core.ssrvlad_map_new(ctypes.byref(drives))
        if not self._map:
            raise ValueError(f"expected drives of at least 1 frame, got {list(frames)}")
        weakref.finalize(self, core.ssrvlad_map_free, ctypes.c_void_p(self._map))
        self._rows: dict[str, Array] = {}
        self._of_drives: dict[str, Array | None] = {}
        self._frames, self._drives = int(starts[-1]), len(frames)

    def __len__(self) -> int:
        return self._frames

    def add(self, name: str, rows: Array, trust: float = 1.0, means: Array | None = None) -> None:
        """Adds a channel. The rows stay where they are, if they are contiguous.

        Args:
            name: of the channel.
            rows: vectors ``(R, D)`` float32 of length 1 or zero, which match nothing; or signs
                ``(R, columns, ...)`` uint8, eight in a byte.
            trust: how much the channel counts before anything is known of a drive.
            means: of the drives, if the rows are only some of theirs: ``(drives, D)`` float32, of
                signs as 1 and -1 ``(drives, columns, bits)``.

        Raises:
            ValueError: the rows are no such array, not one for each frame, or not finite.
        """
        if name in self._rows:
            raise ValueError(f"{name}: expected a name that is new, got {', '.join(self._rows)}")
        if len(rows) != self._frames:
            raise ValueError(
                f"{name}: expected a row for each of {self._frames} frames, got {len(rows)}"
            )
        kept = _checked(rows, name)
        kind = 0 if kept.dtype == np.float32 else 1
        if kind == 0 and kept.ndim != 2:
            raise ValueError(f"{name}: expected vectors (R, D), got {kept.shape}")
        columns, size = 1 if kind == 0 else kept.shape[1], int(np.prod(kept.shape[1 + kind :]))
        of_drives = self._means(name, means, (self._drives, columns * size * (8 if kind else 1)))
        given = struct("channel")(kept.ctypes.data, kind, columns, size, trust, _address(of_drives))
        status = required().ssrvlad_map_add_channel(self._map, ctypes.byref(given))
        if status:
            got = f"{kept.shape}, trust {trust}"
            raise problem(status, f"{name} as finite rows and a trust above 0, got {got}")
        self._rows[name], self._of_drives[name] = kept, of_drives

    def query(
        self,
        queries: Mapping[str, Array],
        standardise: bool = True,
        sweep: bool = True,
        follow: str | None = "offline",
        delay: int = 0,
        top: int = 5,
        threads: int = 1,
    ) -> Found:
        """Finds the queries of one drive.

        Args:
            queries: by the name of each channel of the map, ``(Q, *shape)``; of vectors also from
                several anchors, the usual one in the middle, ``(Q, S, D)``.
            standardise: subtract the mean of each drive, if queries and map have `MIN_FRAMES`.
            sweep: use the anchors that suit the scores best, and move signs to both sides.
            follow: ``"online"``, with ``delay`` later queries, ``"offline"``, or ``None``.
            top: number of candidates of each query.
            threads: that share the rows.

        Raises:
            ValueError: the channels are not those of the map, or an argument is out of range.
            RuntimeError: memory is short.
        """
        if [*queries] != [*self._rows] or not queries:
            wanted, got = (", ".join(names) or "none" for names in (self._rows, queries))
            raise ValueError(f"expected queries by {wanted}, got {got}")
        chosen = steps_of(follow, delay, top, "follow")
        kept = {name: self._of_queries(name, each) for name, each in queries.items()}
        counts = {name: len(each) for name, each in kept.items()}
        if len(set(counts.values())) != 1:
            raise ValueError(f"expected one number of queries by all channels, got {counts}")
        count = next(iter(counts.values()))
        given = (struct("queries") * len(kept))(
            *(self._given(name, each) for name, each in kept.items())
        )
        room = Room(count, top)
        steps = struct("steps")(standardise, sweep, *chosen)
        weights = (ctypes.c_double * len(kept))()
        taken = struct("taken")(weights=ctypes.addressof(weights))
        status = required().ssrvlad_map_query(
            self._map, given, count, ctypes.byref(steps), threads, room.pointer,
            ctypes.byref(taken),
        )  # fmt: skip
        if status:
            raise problem(status, "finite queries, whose scores are at most 1")
        return Found(
            room.decision(),
            bool(taken.standardised),
            taken.width,
            dict(zip(kept, weights, strict=True)),
        )

    def compare(
        self,
        name: str,
        queries: Array,
        standardised: bool,
        sweep: bool,
        threads: int = 1,
        mean: Array | None = None,
    ) -> Comparison:
        """The scores of the queries of one drive by one channel; arguments as for `query`, except
        that ``standardised`` is not asked of the numbers of frames. The ``mean`` of the drive, of
        the shape of those of `add`, is given if the queries are only some of it: it is subtracted,
        and all anchors count."""
        kept, rows = self._of_queries(name, queries), self._rows[name]
        bits = 1 if rows.dtype == np.float32 else 8
        of_drive = self._means(name, mean, (bits * math.prod(rows.shape[1:]),))
        given, width = self._given(name, kept), ctypes.c_int64()
        given.mean = _address(of_drive)
        number = [*self._rows].index(name)
        comparison = required().ssrvlad_map_compare(
            self._map, number, ctypes.byref(given), len(kept), standardised, sweep, threads,
            ctypes.byref(width),
        )  # fmt: skip
        if not comparison:
            raise ValueError(
                f"{name}: expected finite queries that fit in memory, got {kept.shape}"
            )
        return Comparison(comparison, self, len(kept), width.value)

    def _of_queries(self, name: str, queries: Array) -> Array:
        rows, kept = self._rows[name], _checked(queries, name)
        anchors = kept.ndim - rows.ndim if rows.dtype == np.float32 else 0
        fits = kept.dtype == rows.dtype and kept.shape[1 + anchors :] == rows.shape[1:]
        if not fits or (anchors == 1 and kept.shape[1] % 2 == 0):
            wanted = ", ".join(map(str, rows.shape[1:]))
            raise ValueError(
                f"{name}: expected queries (Q, {wanted}) {rows.dtype}, of vectors also (Q, S, D) "
                f"with an odd S, got {kept.shape} {kept.dtype}"
            )
        return kept

    @staticmethod
    def _means(name: str, means: Array | None, shape: tuple[int, ...]) -> Array | None:
        if means is None:
            return None
        kept = np.ascontiguousarray(means, np.float32)
        if kept.size != math.prod(shape):
            raise ValueError(f"{name}: expected means of {shape} numbers, got {kept.shape}")
        return kept

    def _given(self, name: str, queries: Array) -> Any:
        anchors = queries.shape[1] if queries.ndim > self._rows[name].ndim else 1
        return struct("queries")(queries.ctypes.data, anchors)


class Comparison:
    """The scores ``(Q, R)`` of the queries of one drive, computed in blocks; for one thread.

    Attributes:
        width: of the sweep, in anchors to each side.
    """

    def __init__(self, handle: int, of: Map, queries: int, width: int) -> None:
        self.width, self._handle, self._map, self._queries = width, handle, of, queries
        weakref.finalize(self, required().ssrvlad_comparison_free, ctypes.c_void_p(handle))

    def __len__(self) -> int:
        return self._queries

    def __getitem__(self, query: int, /) -> Floats:
        """``(R,)`` float32, -inf where there can be no match."""
        scores = np.empty(len(self._map), np.float32)
        status = required().ssrvlad_comparison_scores(self._handle, query, scores.ctypes.data)
        if status:
            raise problem(status, f"a query below {self._queries}, got {query}")
        return scores


def match(
    queries: Array,
    rows: tuple[Array, Array],
    first: int,
    excluded: Array | None,
    threads: int,
    best: tuple[Array, Array],
) -> None:
    """Puts rows of a map among the best of each query, see ``ssrvlad_match``.

    Args:
        queries: ``(Q, D)`` float32, of length 1, or NaN, which finds nothing.
        rows: ``(R, D)`` float32, and their lengths ``(R,)`` float32.
        first: number of the first row.
        excluded: ``(Q, R)`` bool, rows that are no candidates.
        threads: that share the queries.
        best: scores ``(Q, top)`` float32 and rows int64 of earlier rows, in falling order; they are
            changed.

    All arrays are C-contiguous.

    Raises:
        ValueError: D or top is 0.
    """
    vectors, lengths = rows
    given = struct("rows")(
        vectors.ctypes.data, lengths.ctypes.data, _address(excluded), *vectors.shape, first
    )
    status = required().ssrvlad_match(
        ctypes.byref(given), queries.ctypes.data, len(queries), best[0].shape[1], threads,
        *(each.ctypes.data for each in best),
    )  # fmt: skip
    if status:
        raise problem(status, f"vectors of at least 1 number, got {vectors.shape}")


def _address(array: Array | None) -> int | None:
    return None if array is None else array.ctypes.data


def _checked(array: Array, name: str) -> Array:
    """Contiguous vectors or signs."""
    kept = np.ascontiguousarray(array, np.float32 if array.dtype.kind == "f" else None)
    are_signs = kept.dtype == np.uint8 and kept.ndim >= 3
    if not are_signs and not (kept.dtype == np.float32 and kept.ndim in (2, 3)):
        raise ValueError(
            f"{name}: expected vectors of float32 or signs (N, columns, ...) of uint8, got "
            f"{kept.shape} {kept.dtype}"
        )
    return kept
