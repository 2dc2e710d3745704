"""Frames of video files, by their presentation times. Needs the extra ``video``."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
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
from .video_run import DecodingRun

_TOLERATED = 0.5
"""Seconds by which a header may say that a video is longer than its frames."""
_STARTS = 4
"""Key frames with which decoding is tried to begin."""
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
    frame at or before it with a decoder that has seen nothing: whatever was read before, a frame is
    the same or refused. Reading in order decodes each frame once.

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
        self.times = [time for time, _ in kept]
        self._numbers: list[int | None] = [number for _, number in kept]
        self._keys = sorted(number for _, number in kept if packets[number].is_key)
        self._ranks: dict[int, int] = {}
        self._is_ordered = not self._source.lacks_times
        self._lock = Lock()
        self._failed = dict[tuple[int, int], int]()
        """By the ends of runs, the first packet that is known to be damaged."""
        self._run = DecodingRun(self._source, {}, 0, 0, self._failed)

    def pixels(self, time: int) -> npt.NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 of the frame at a time, turned upright; a ValueError if it does not
        decode, or an earlier one that it may depend on, see `DecodingRun`."""
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
        if not self._is_ordered:
            self._numbers, self._is_ordered = self._order_of_showing(), True
        if not self._ranks:
            self._ranks = {n: rank for rank, n in enumerate(self._numbers) if n is not None}
        number = self._numbers[rank]
        if number is None:
            return None
        place, tried = bisect_right(self._keys, number) - 1, 0
        stop = self._stop_of(self._keys[place] if place >= 0 else 0)
        while place >= 0 and tried < _STARTS:
            start, place = self._keys[place], place - 1
            if self._ranks.get(start, math.inf) > rank:
                continue
            run = self._run_of(start, stop, number)
            if run and not run.opens():  # an intra refresh, which ends later
                self._keys.remove(start)
                continue
            frame = run and run.frame(number)
            if frame is not None:
                return frame
            tried += 1
        run = None if tried else self._run_of(0, stop, number)
        return run and run.frame(number)

    def _run_of(self, start: int, stop: int, number: int) -> DecodingRun | None:
        """A run that may give the frame of a packet; ``None`` if it was damaged before it."""
        if self._failed.get((start, stop), math.inf) <= number:
            return None
        if self._run.ends != (start, stop) or self._run.has_passed(number):
            self._run = DecodingRun(self._source, self._ranks, start, stop, self._failed)
        return self._run

    def _stop_of(self, start: int) -> int:
        """The packet before which decoding from a key frame ends: the next key frame, or after
        frames that are decoded after that one and shown before it."""
        place, count = bisect_right(self._keys, start), len(self._source.packets)
        key, following = (*self._keys[place : place + 2], count, count)[:2]
        shown = self._ranks.get(key, -1)
        earlier = (n for n in range(key, following) if self._ranks.get(n, shown) < shown)
        return max(earlier, default=key - 1) + 1

    def _order_of_showing(self) -> list[int | None]:
        """The packets in the order in which a decoder shows them, between two key frames each
        time; ``None`` where one of these is not shown."""
        numbers = [number for number in self._numbers if number is not None]
        groups: dict[int, list[int]] = {}
        for number, frame in self._source.decoded(0, len(self._source.packets)):
            if frame is not None:
                groups.setdefault(bisect_right(self._keys, number), []).append(number)
        order = list[int | None]()
        for place in range(len(self._keys) + 1):
            first, stop = (0, *self._keys, math.inf)[place : place + 2]
            count = bisect_left(numbers, stop) - bisect_left(numbers, first)
            group = groups.get(place, [])
            order += group if len(group) == count else [None] * count
        return order


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
