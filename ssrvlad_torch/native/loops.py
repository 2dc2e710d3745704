"""Loop closures in a live stream, by the native core; see ssrvlad_loops.h.

Needs neither torch nor the rest of the package, so programs without torch use it too.
"""

from __future__ import annotations

import ctypes
import math
import weakref
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import failure, require, required
from .addresses import address
from .headers import number, struct

Array = npt.NDArray[Any]

SCAN_ABOVE = number("SCAN_ABOVE")
"""Old frames up to which each is compared by all channels."""

_MAX_INT64 = 2**63 - 1


class Reason(StrEnum):
    """Why a frame closes a loop or does not; see `loops.result.LoopResult`."""

    ACCEPTED = "accepted"
    EMPTY_FRAME = "empty_frame"
    NO_CANDIDATE = "no_candidate"
    TOO_RECENT = "too_recent"
    AMBIGUOUS = "ambiguous"
    BELOW_THRESHOLD = "below_threshold"


_REASONS = {number(reason.name): reason for reason in Reason}


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


class LoopStep(NamedTuple):
    """The result of a frame; rows are earlier frames in the order in which they came.

    Attributes:
        reason: why it closes a loop or does not.
        candidate: the most probable old row, or ``None``; without one the others are empty.
        score: its score.
        probability: that the place is near it.
        places: the most probable rows with their probabilities, best first.
        first: the first row near the candidate, in its stretch.
        near: probabilities of the rows from there on.
    """

    reason: Reason
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
        exclude: number of the last frames of the present stretch, which are no candidates.
        threshold: least probability of a loop, 0 to 1.
        scan_above: number of old frames above which, if they have signs, all are compared by a
            part of these, and by all channels near and probable ones and a sample; at least 1.

    Raises:
        RuntimeError: there is no native core, or it refuses a setting or a shape.
        MemoryError: memory is short.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        exclude: int = 50,
        threshold: float = 0.8,
        scan_above: int = SCAN_ABOVE,
    ) -> None:
        self._library, self.channels = required(), tuple(channels)
        described = (struct("loops_channel") * len(channels))(*map(_described, channels))
        settings = struct("loops_settings")(min(exclude, _MAX_INT64), threshold, scan_above)
        new = self._library.ssrvlad_loops_new_for
        handle = new(number("INTERFACE"), settings, described, len(channels))
        if not handle:
            raise failure(RuntimeError)
        self._handle = ctypes.c_void_p(handle)
        weakref.finalize(self, self._library.ssrvlad_loops_free, self._handle)

    def __len__(self) -> int:
        return int(self._library.ssrvlad_loops_rows(self._handle))

    @property
    def weights(self) -> dict[str, float]:
        """The present weight of each channel by its name."""
        weights = (ctypes.c_double * len(self.channels))()
        self._library.ssrvlad_loops_weights(self._handle, weights)
        return dict(zip([channel.name for channel in self.channels], weights, strict=True))

    def update(
        self,
        descriptors: Mapping[str, Array],
        stamp: float = math.nan,
        starts: bool = False,
        threads: int = 1,
    ) -> LoopStep:
        """Looks for the place of the next frame among the earlier ones, then stores it.

        Args:
            descriptors: of each channel by its name: ``shape``, or of vectors from S anchors
                ``(S, *shape)`` with the usual one in the middle, S odd.
            stamp: seconds, not less than that of the frame before.
            starts: whether the frame is the first of a sequence.
            threads: that share the comparison with many frames.

        Raises:
            ValueError: a descriptor has another shape, or cannot be one; the stream is unchanged.
            MemoryError: memory is short; the stream refuses all further frames.
        """
        arrays, anchors = [], []
        for channel in self.channels:
            array = np.ascontiguousarray(descriptors[channel.name])
            anchors.append(max(1, array.size // math.prod(channel.shape)))
            arrays.append(array.reshape(-1, *array.shape[-len(channel.shape) :]))
        result = struct("loop")()
        passed = self._addresses(arrays, anchors), (ctypes.c_int64 * len(anchors))(*anchors)
        update = self._library.ssrvlad_loops_update
        require(update(self._handle, *passed, stamp, bool(starts), threads, result))
        return _step_of(result)

    def extend(self, descriptors: Mapping[str, Array], stamps: Array | None, starts: Array) -> None:
        """Stores frames that are known as if they had come, without results.

        Args:
            descriptors: ``(N, *shape)`` of each channel by its name.
            stamps: ``(N,)`` seconds, NaN where they are not known.
            starts: ``(N,)`` whether each is the first of a sequence.

        Raises:
            ValueError, MemoryError: as for `update`.
        """
        first = np.ascontiguousarray(starts, np.uint8)
        times = None if stamps is None else np.ascontiguousarray(stamps, np.float64)
        frames = len(first)
        arrays = [np.ascontiguousarray(descriptors[channel.name]) for channel in self.channels]
        addresses = self._addresses(arrays, [frames] * len(arrays))
        when = address(times, (frames,), "float64"), address(first, (frames,), "uint8")
        require(self._library.ssrvlad_loops_extend(self._handle, addresses, *when, frames))

    def descriptors(self, name: str, first: int, last: int) -> Array:
        """``(last - first, *shape)``, a copy, by the channel with a name."""
        index = [channel.name for channel in self.channels].index(name)
        channel = self.channels[index]
        rows = np.empty((last - first, *channel.shape), channel.dtype)
        copy = self._library.ssrvlad_loops_descriptors
        require(copy(self._handle, index, first, last, rows.ctypes.data))
        return rows

    def _addresses(self, arrays: Sequence[Array], counts: Sequence[int]) -> Any:
        """The addresses of descriptors by each channel, so many one after another."""
        addresses = []
        for channel, array, count in zip(self.channels, arrays, counts, strict=True):
            try:
                addresses.append(address(array, (count, *channel.shape), channel.dtype))
            except ValueError as error:
                raise ValueError(f"{channel.name}: {error}") from error
        return (ctypes.c_void_p * len(addresses))(*addresses)


def _step_of(loop: Any) -> LoopStep:
    reason = _REASONS[loop.reason]
    if loop.candidate < 0:
        return LoopStep(reason)
    places = tuple((place.row, place.probability) for place in loop.best[: loop.places])
    near = tuple(loop.probabilities[: loop.rows])
    return LoopStep(reason, loop.candidate, loop.score, loop.probability, places, loop.first, near)


def _described(channel: Channel) -> Any:
    shape = (ctypes.c_int64 * 3)(*(*channel.shape, 1, 1)[:3])
    return struct("loops_channel")(channel.dtype == "uint8", shape, channel.trust)
