"""Frames of video files, by their presentation times. Needs the extra ``video``."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels, npy_bytes
from .frame_file import FrameFile
from .names import VIDEO_SUFFIXES, absolute
from .video_packets import VideoPackets

_TOLERATED = 0.5
"""Seconds by which a header may say that a video is longer than its frames."""
_BUFFERED = 16
_LEAP, _LEAP_STEPS = 10, 100
"""A leap of time is longer than 10 seconds, which is FFmpeg's bound, and than 100 frames."""
_REORDERED = 16
"""Frames by which a decoder moves one to show them in order."""


@dataclass(frozen=True)
class VideoFile(FrameFile):
    """One frame of a video; its ``row`` is its presentation time in the units of the stream. With
    ``damage``, which says why, it stands for frames that cannot be read."""

    damage: str = ""

    @property
    def location(self) -> str:
        """Video and time, for messages."""
        return f"{self.path} at {int(self.name) / 1e6:.6f} s"

    def _content(self) -> bytes:
        assert self.row is not None
        if self.damage:
            raise ValueError(f"the video is damaged: {self.damage}")
        return npy_bytes(_open(self.path, self.state).pixels(self.row))


def is_video(path: Path) -> bool:
    """Whether the name of a file is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def video_files(path: Path) -> list[FrameFile]:
    """The frames of a video in order of presentation; their sequence has no name yet.

    A frame is named by its time after the first frame, in microseconds: the name does not depend
    on which other frames are used. Its stamp is this time in seconds, after the file's creation
    time if the file has one. Nothing is decoded. A frame that does not decode is refused when it is
    read. The last files stand for frames that cannot be read: one for those whose times leap, and
    one for those that are missing at the end, if the file says how long it was.
    A file that cannot be read, or without frames that have times, is a ValueError; without the
    extra ``video``, an ImportError.
    """
    folder, video = absolute(path), _open(path, FrameFile("", "", path).state)

    def file(time: int, damage: str = "") -> VideoFile:
        seconds = (time - video.times[0]) * video.unit
        name, stamp = f"{round(seconds * 10**6):010d}", video.created + float(seconds)
        return VideoFile("", name, path, time, folder=folder, stamp=stamp, damage=damage)

    return [*map(file, video.times), *(file(*damage) for damage in video.damages())]


def played(files: Sequence[FrameFile]) -> list[float]:
    """The seconds of video up to each of the files; empty unless all are frames of videos."""
    if not files or not all(isinstance(file, VideoFile) for file in files):
        return []
    steps = (b.stamp - a.stamp if a.path == b.path else 0.0 for a, b in pairwise(files))
    return [*accumulate(steps, initial=0.0)]


class _Video:
    """The frames of a video, ranked by their times. For a frame, decoding begins at the last key
    frame at or before it with a decoder that has seen nothing, or, where that fails, at the key
    frame before, to which an open group may refer: whatever was read before, a frame is the same or
    refused. Reading in order decodes each frame once, of open groups twice.

    Attributes:
        times: presentation times of all frames, increasing, in units of ``unit`` seconds.
        created: time of the first frame in seconds since 1970, or 0 if the file does not say it.
    """

    def __init__(self, path: Path) -> None:
        self._source = VideoPackets(path)
        self.unit, self.created = self._source.unit, self._source.created
        packets = self._source.packets
        shown = [(p.time, number) for number, p in enumerate(packets) if p.time is not None]
        kept = _without_leaps(shown, self.unit, self._source.duration)
        self._leaping = sorted({time for time, _ in shown} - {time for time, _ in kept})
        kept.sort()
        self.times, self._by_time = [time for time, _ in kept], [number for _, number in kept]
        self._keys = sorted({0, *(number for number in self._by_time if packets[number].is_key)})
        self._runs = dict[tuple[int, int], _Run]()
        self._lock = Lock()

    def pixels(self, time: int) -> npt.NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 of the frame at a time, turned upright; a ValueError if it does not
        decode, or an earlier one that it may depend on, see `_Run`."""
        with self._lock:
            frame = self._frame(bisect_left(self.times, time))
            if frame is None:
                raise ValueError("the frame does not decode")
            check_pixels(frame.height, frame.width)
            pixels = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90) % 4)
            return np.ascontiguousarray(pixels)

    def damages(self) -> list[tuple[int, str]]:
        """Times outside `times` at which frames cannot be read, and what is damaged."""
        steps = np.diff(self.times) if len(self.times) > 1 else np.array([self._source.duration])
        end = self.times[0] + self._source.duration
        following = self.times[-1] + round(float(np.median(steps)))
        damages = list[tuple[int, str]]()
        if self._leaping:
            seconds = float((self._leaping[-1] - self.times[0]) * self.unit)
            count = f"{len(self._leaping)} frame{'s' if len(self._leaping) > 1 else ''}"
            reason = f"the times of {count} leap, for example to {seconds:.3f} s"
            damages.append((self._leaping[-1], reason))
        if end > following + max(int(steps.max()), round(_TOLERATED / self.unit)):
            seconds = float((end - following) * self.unit)
            damages.append((following, f"its last {seconds:.3f} s cannot be read"))
        return damages

    def _frame(self, rank: int) -> Any:
        """The frame of a rank; ``None`` if it, or one before it from the key frame on, fails."""
        number = self._numbers[rank]
        if number is None:
            return None
        place = bisect_right(self._keys, number) - 1
        while place and self._ranks.get(self._keys[place], math.inf) > rank:
            place -= 1
        first, frame = self._keys[place], None
        for start in (first, self._keys[max(place - 1, 0)]):
            if frame is None:
                run = self._runs.pop((start, first), None)
                if run is None or self._ranks[number] in run.dropped:
                    run = _Run(self._source, self._ranks, start, first, self._stop_of(first))
                frame = run.frame(number, self._latest[number])
                self._runs = dict([*self._runs.items()][-1:]) | {(start, first): run}
        return frame

    def _stop_of(self, start: int) -> int:
        """The packet before which decoding from a key frame ends: the next key frame, or after
        frames that are decoded after that one and shown before it."""
        place, count = bisect_right(self._keys, start), len(self._source.packets)
        key, following = (*self._keys[place : place + 2], count, count)[:2]
        shown = self._ranks.get(key, -1)
        earlier = (n for n in range(key, following) if self._ranks.get(n, shown) < shown)
        return max(earlier, default=key - 1) + 1

    @cached_property
    def _ranks(self) -> dict[int, int]:
        """The ranks of the frames by the numbers of their packets."""
        return {number: rank for rank, number in enumerate(self._numbers) if number is not None}

    @cached_property
    def _latest(self) -> list[int]:
        """The highest rank of the packets up to each."""
        ranks = (self._ranks.get(number, 0) for number in range(len(self._source.packets)))
        return list(accumulate(ranks, max))

    @cached_property
    def _numbers(self) -> list[int | None]:
        """The packets in the order of showing; where times do not tell it, in the order in which a
        decoder shows them between two key frames, ``None`` where one of these is not shown."""
        if not self._source.lacks_times:
            return [*self._by_time]
        groups = {key: list[int]() for key in self._keys}
        for number, frame in self._source.decoded(0, len(self._source.packets)):
            if frame is not None:
                groups[self._keys[bisect_right(self._keys, number) - 1]].append(number)
        order = list[int | None]()
        for (first, group), stop in zip(groups.items(), (*self._keys[1:], math.inf), strict=True):
            count = bisect_left(self._by_time, stop) - bisect_left(self._by_time, first)
            order += group if len(group) == count else [None] * count
        return order


class _Run:
    """One run of a decoder through the packets from number ``start`` up to ``stop``, for the frames
    from the key frame ``first`` on, as far as was asked. The last `_BUFFERED` stay in memory; the
    ranks of those before are ``dropped``.

    A decoder conceals damage, and frames that depend on a concealed one decode without an error:
    with a damaged packet, all later ones fail.
    """

    def __init__(
        self, source: VideoPackets, ranks: Mapping[int, int], start: int, first: int, stop: int
    ) -> None:
        self._ranks, self._outputs, self._first = ranks, source.decoded(start, stop), first
        self._buffer, self.dropped = dict[int, Any](), set[int]()
        self._reached, self._failed = -1, math.inf

    def frame(self, number: int, latest: int) -> Any:
        """The frame of a packet; ``None`` if it or one before it is damaged, or it has none.
        ``latest`` is the highest rank of the packets up to it."""
        while self._reached < latest and number < self._failed:
            output = next(self._outputs, None)
            if output is None:
                break
            self._take(*output)
        return self._buffer.get(self._ranks[number]) if number < self._failed else None

    def _take(self, number: int, frame: Any) -> None:
        rank = self._ranks.get(number, math.inf)
        if number < self._first or rank < self._ranks.get(self._first, 0):
            return  # shown before the first, it may depend on what was not decoded
        if frame is None or frame.is_corrupt:
            self._failed = min(self._failed, number)
        if frame is None or math.isinf(rank):
            return
        self._reached = max(self._reached, int(rank))
        self._buffer[int(rank)] = frame
        if len(self._buffer) > _BUFFERED:
            self.dropped.add(min(self._buffer))
            del self._buffer[min(self._buffer)]


def _without_leaps(
    shown: list[tuple[int, int]], unit: Fraction, duration: int
) -> list[tuple[int, int]]:
    """Pairs of a time and a number, without those whose time leaps from that of the packet before.
    Where the header says that the video lasts until the last of them, and they rise, it may have
    paused. Else the longest stretch without a leap is right, and what continues it."""
    times = [time for time, _ in shown]
    steps = np.diff(np.array(sorted(times), np.float64))
    leap = max(_LEAP / unit, _LEAP_STEPS * float(np.median(steps)) if len(steps) else 0)
    moved = np.argsort(np.array(times), kind="stable") - np.arange(len(times))
    beyond = max(times) - min(times) - duration
    allowed = max(_TOLERATED / unit, *steps, 0)
    if duration and np.abs(moved).max() <= _REORDERED and beyond <= allowed:
        return shown
    borders = [0, *(n for n in range(1, len(times)) if abs(times[n] - times[n - 1]) > leap)]
    stretches = list(pairwise([*borders, len(times)]))
    first, stop = max(stretches, key=lambda ends: ends[1] - ends[0])
    kept = list(range(first, stop))
    for direction in (range(first - 1, -1, -1), range(stop, len(times))):
        last = times[first if direction.step < 0 else stop - 1]
        for place in direction:
            if abs(times[place] - last) <= leap:
                kept.append(place)
                last = times[place]
    return [shown[place] for place in sorted(kept)]


@lru_cache(maxsize=4)
def _open(path: Path, state: str) -> _Video:
    """A video, opened again when the state of the file changes."""
    del state
    return _Video(path)
