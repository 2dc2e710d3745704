"""Loop closures in a live stream, by the native core; see ssrvlad_loops.h.

Needs neither torch nor the rest of the package, so programs without torch use it too.
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
from .headers import struct

Array = npt.NDArray[Any]

REASONS = (
    *("accepted", "empty_frame", "no_candidate", "too_recent", "ambiguous", "below_threshold"),
)
"""Why a frame closes a loop or does not; see `ssrvlad_torch.loops.result`."""

PLACES, NEAR = 5, 5
"""Places of a result, at most; rows on each side of a row that show the same place."""

SCAN_ABOVE = 50_000
"""Old frames up to which each is compared by all channels."""


class Channel(NamedTuple):
    """What is known of each frame.

    Attributes:
        name: of the channel.
        shape: of the descriptor of a frame: ``(length,)`` of a vector, ``(columns, rows, bytes)``
            of signs.
        dtype: ``"float32"`` for vectors, of length 1 or zero; ``"uint8"`` for signs, eight in a
            byte.
        trust: how much the channel counts before it has led; label maps count 1.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str = "float32"
    trust: float = 1.0


class Found(NamedTuple):
    """The result of a frame; rows are earlier frames in the order in which they came.

    Attributes:
        reason: one of `REASONS`.
        candidate: the most probable old row, or ``None``; without one the others are empty.
        score: its score.
        probability: that the place is near it.
        places: the most probable rows with their probabilities, best first.
        first: the first row near the candidate, in its stretch.
        near: probabilities of the rows from there on.
    """

    reason: str
    candidate: int | None = None
    score: float | None = None
    probability: float | None = None
    places: tuple[tuple[int, float], ...] = ()
    first: int = 0
    near: tuple[float, ...] = ()


class Loops:
    """A live stream in the native core. One thread at a time may use it.

    Args:
        channels: what is known of each frame; where the first is zero, a frame is empty.
        exclude: number of the last frames, which are no candidates.
        threshold: least probability of a loop, 0 to 1.
        scan_above: number of old frames above which, if they have signs, all are compared by a
            part of these, and only some by all channels; at least 1.

    Raises:
        RuntimeError: there is no native core, or it refuses a setting or a shape.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        exclude: int = 50,
        threshold: float = 0.8,
        scan_above: int = SCAN_ABOVE,
    ) -> None:
        self._library, self.channels = required(), tuple(channels)
        made = [_of(each) for each in channels]
        given = (struct("loops_channel") * len(made))(*made)
        # more frames than fit are excluded by the largest number that fits
        settings = struct("loops_settings")(min(exclude, 2**63 - 1), threshold, scan_above)
        handle = self._library.ssrvlad_loops_new(settings, given, len(made))
        if not handle:
            raise RuntimeError(
                "the native core refuses the settings or channels, or memory is short"
            )
        self._handle = ctypes.c_void_p(handle)
        weakref.finalize(self, self._library.ssrvlad_loops_free, self._handle)

    def __len__(self) -> int:
        return int(self._library.ssrvlad_loops_rows(self._handle))

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each channel by its name."""
        weights = (ctypes.c_double * len(self.channels))()
        self._library.ssrvlad_loops_weights(self._handle, weights)
        return dict(zip([each.name for each in self.channels], weights, strict=True))

    def update(
        self,
        descriptors: Mapping[str, Array],
        stamp: float = math.nan,
        starts: bool = False,
        threads: int = 1,
    ) -> Found:
        """Looks for the place of the next frame among the earlier ones, then stores it.

        Args:
            descriptors: of each channel by its name: ``shape``, or of vectors from S anchors
                ``(S, *shape)`` with the usual one in the middle, S odd.
            stamp: seconds, not less than that of the frame before.
            starts: whether the frame is the first of a sequence.
            threads: that share the comparison with many frames.

        Raises:
            ValueError: a descriptor has another shape, or cannot be one.
        """
        result = struct("loop")()
        given = self._given(descriptors)
        anchors = [
            each.size // math.prod(c.shape) for c, each in zip(self.channels, given, strict=True)
        ]
        counts = (ctypes.c_int64 * len(given))(*anchors)
        _require(
            self._library.ssrvlad_loops_update(
                self._handle, _pointers(given), counts, stamp, bool(starts), threads, result
            )
        )
        return _found(result)

    def extend(self, descriptors: Mapping[str, Array], stamps: Array | None, starts: Array) -> None:
        """Stores frames that are known as if they had come, without results.

        Args:
            descriptors: ``(N, *shape)`` of each channel by its name.
            stamps: ``(N,)`` seconds, NaN where they are not known.
            starts: ``(N,)`` whether each is the first of a sequence.

        Raises:
            ValueError: as for `update`.
        """
        first = np.ascontiguousarray(starts, np.uint8)
        times = None if stamps is None else np.ascontiguousarray(stamps, np.float64)
        for name, each in (("starts", first), ("stamps", times)):
            if each is not None and each.shape != (len(first),):
                raise ValueError(f"{name}: expected shape ({len(first)},), got {each.shape}")
        given = self._given(descriptors, len(first))
        _require(
            self._library.ssrvlad_loops_extend(
                self._handle,
                _pointers(given),
                None if times is None else times.ctypes.data,
                first.ctypes.data,
                len(first),
            )
        )

    def descriptors(self, name: str, first: int, last: int) -> Array:
        """``(last - first, *shape)``, a copy, by the channel with a name."""
        number = [each.name for each in self.channels].index(name)
        channel = self.channels[number]
        rows = np.empty((last - first, *channel.shape), channel.dtype)
        _require(
            self._library.ssrvlad_loops_descriptors(
                self._handle, number, first, last, rows.ctypes.data
            )
        )
        return rows

    def _given(self, descriptors: Mapping[str, Array], frames: int | None = None) -> list[Array]:
        """The arrays of the channels as the core reads them: of one frame, or of so many."""
        given, of = [], "" if frames is None else f" of {frames} frames"
        for channel in self.channels:
            array = np.ascontiguousarray(descriptors[channel.name])
            shape = array.shape[-len(channel.shape) :]
            fits = frames is None or array.shape == (frames, *shape)
            if array.dtype != channel.dtype or shape != channel.shape or not fits:
                raise ValueError(
                    f"{channel.name}: expected descriptors {channel.shape} {channel.dtype}{of}, "
                    f"got {array.shape} {array.dtype}"
                )
            given.append(array)
        return given


def _found(loop: Any) -> Found:
    reason = REASONS[loop.reason]
    if loop.candidate < 0:
        return Found(reason)
    places = tuple((each.row, each.probability) for each in loop.best[: loop.places])
    near = tuple(loop.probabilities[: loop.rows])
    return Found(reason, loop.candidate, loop.score, loop.probability, places, loop.first, near)


def _of(channel: Channel) -> Any:
    shape = (*channel.shape, 1, 1)[:3]
    return struct("loops_channel")(
        channel.dtype == "uint8", (ctypes.c_int64 * 3)(*shape), channel.trust
    )


def _pointers(arrays: Sequence[Array]) -> Any:
    return (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))


def _require(status: int) -> None:
    if status == -1:
        raise MemoryError("not enough memory for the frames of the stream")
    if status:
        raise ValueError("expected descriptors of length 1 or zero, and an odd number of anchors")
