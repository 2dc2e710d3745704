"""Frames of video files, by their presentation times. Needs the extra ``video``."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from functools import lru_cache
from itertools import accumulate, pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels, npy_bytes, one_line, requiring
from .frame_file import FrameFile
from .names import VIDEO_SUFFIXES, absolute

_FORMATS = "mov,matroska,avi,mpegts"
"""No format that names other files, as playlists do."""

_BUFFERED = 16
_TOLERATED = 0.5
"""Seconds by which a header may say that a video is longer than its frames."""


@dataclass(frozen=True)
class VideoFile(FrameFile):
    """One frame of a video; its ``row`` is its presentation time in the units of the stream.
    ``lost`` are the seconds from here to the end that cannot be read; 0 for a frame."""

    lost: float = 0

    @property
    def location(self) -> str:
        """Video and time, for messages."""
        return f"{self.path} at {int(self.name) / 1e6:.6f} s"

    def _content(self) -> bytes:
        assert self.row is not None
        if self.lost:
            raise ValueError(f"the video is damaged: its last {self.lost:.3f} s cannot be read")
        return npy_bytes(_open(self.path, self.state).pixels(self.row))


def is_video(path: Path) -> bool:
    """Whether the name of a file is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def video_files(path: Path) -> list[FrameFile]:
    """The frames of a video in order of presentation; their sequence has no name yet.

    A frame is named by its time after the first frame, in microseconds: the name does not depend
    on which other frames are used. Its stamp is this time in seconds, after the file's creation
    time if the file has one. Nothing is decoded. A frame that does not decode is refused when it is
    read; of a truncated file that says how long it was, the last one stands for all that are lost.
    A file that cannot be read, or without frames that have times, is a ValueError; without the
    extra ``video``, an ImportError.
    """
    video, folder, files = _Video(path), absolute(path), list[FrameFile]()
    for time in (*video.times, *video.missing()):
        seconds = (time - video.times[0]) * video.unit
        name, stamp = f"{round(seconds * 10**6):010d}", video.created + float(seconds)
        lost = float((video.end - time) * video.unit) if time > video.times[-1] else 0
        files.append(VideoFile("", name, path, time, folder=folder, stamp=stamp, lost=lost))
    return files


def played(files: Sequence[FrameFile]) -> list[float]:
    """The seconds of video up to each of the files; empty unless all are frames of videos."""
    if not files or not all(isinstance(file, VideoFile) for file in files):
        return []
    steps = (b.stamp - a.stamp if a.path == b.path else 0.0 for a, b in pairwise(files))
    return [*accumulate(steps, initial=0.0)]


class _Video:
    """The first video stream of a file. Reading frames in order decodes each once.

    Attributes:
        times: presentation times of all frames, increasing, in units of ``unit`` seconds.
        end: the time at which the video ends by its header; that of the last frame if unknown.
        created: time of the first frame in seconds since 1970, or 0 if the file does not say it.
    """

    def __init__(self, path: Path) -> None:
        with requiring("video", f"{path} needs"):
            import av
        self._errors = av.error.FFmpegError
        try:
            options = {"format_whitelist": _FORMATS}
            self._container = av.open(str(path), options=options, metadata_errors="replace")
            if not self._container.streams.video:
                raise ValueError("it has no stream of pictures")
            self._stream = self._container.streams.video[0]
            check_pixels(self._stream.height, self._stream.width)
            self._stream.thread_type = "AUTO"
            self._stream.codec_context.options = {"err_detect": "explode"}
        except Exception as error:  # damaged files raise any exception
            raise ValueError(f"{path} is not a readable video: {one_line(error)}") from error
        self.unit = Fraction(self._stream.time_base or 0)
        packets = sorted(self._scan())
        if not packets or not self.unit:
            raise ValueError(f"{path} holds no frames with presentation times")
        self.times = [time for time, _, _ in packets]
        self._keys = [(time, decoded) for time, is_key, decoded in packets if is_key]
        self._order = sorted((decoded, time) for time, _, decoded in packets)
        self._decoded = {time: decoded for time, _, decoded in packets}
        self.end = self.times[0] + self._duration()
        self.created = 0.0
        with suppress(KeyError, ValueError):
            created = datetime.fromisoformat(self._container.metadata["creation_time"])
            self.created = created.timestamp()
        self._lock = Lock()
        self._start(self.times[0])

    def pixels(self, time: int) -> npt.NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 of the frame at a time, turned upright; a ValueError if it does not
        decode, or an earlier one that it may depend on: decoders conceal that. The last `_BUFFERED`
        frames stay in memory."""
        with self._lock:
            key, first = self._key(time)
            last = self._decoded[time]
            here = slice(bisect_left(self._order, (first,)), bisect_left(self._order, (last + 1,)))
            before = [shown for _, shown in self._order[here]] or [time]
            if time not in self._buffer and (not self._reached <= time or key > self._reached):
                self._start(time)
            if self._reached < max(before):
                self._decode_up_to(max(before))
            frame = self._buffer.get(time)
            is_whole = self._whole.issuperset(before) if self._failed else frame is not None
            if frame is None or not is_whole:
                raise ValueError("the frame does not decode")
            check_pixels(frame.height, frame.width)
            pixels = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90) % 4)
            return np.ascontiguousarray(pixels)

    def missing(self) -> list[int]:
        """The time after the last frame, if the video should go on there for more than a frame."""
        steps = np.diff(self.times) if len(self.times) > 1 else np.array([self.end])
        following = self.times[-1] + round(float(np.median(steps)))
        longest = max(int(steps.max()), round(_TOLERATED / self.unit))
        return [following] if self.end > following + longest else []

    def _scan(self) -> Iterator[tuple[int, bool, int]]:
        """Of every shown frame: time, whether decoding can begin there, when it is decoded."""
        seen = set[int]()
        with suppress(self._errors):  # a truncated file ends here
            for packet in self._container.demux(self._stream):
                if packet.pts is None or packet.is_discard or packet.pts in seen:
                    continue
                seen.add(packet.pts)
                decoded = packet.pts if packet.dts is None else packet.dts
                yield packet.pts, packet.is_keyframe, decoded

    def _duration(self) -> int:
        """How long the header says that the stream is, in its units; 0 if it does not say."""
        if self._stream.duration:
            return int(self._stream.duration)
        hours, _, rest = self._stream.metadata.get("DURATION", "").partition(":")  # Matroska
        minutes, _, seconds = rest.partition(":")
        try:
            total = 3600 * int(hours) + 60 * int(minutes) + float(seconds)
        except ValueError:
            return 0
        return round(total / self.unit)

    def _key(self, time: int) -> tuple[int, int]:
        """The last frame at or before a time at which decoding can begin: its time, and when it is
        decoded. The first frame if none is."""
        place = bisect_right(self._keys, time, key=lambda key: key[0])
        return self._keys[place - 1] if place else (self.times[0], self.times[0])

    def _start(self, time: int) -> None:
        """Goes to the last frame at or before a time at which decoding can begin."""
        self._container.seek(self._key(time)[1], stream=self._stream)
        self._buffer = dict[int, Any]()
        self._whole, self._failed = set[int](), False
        self._reached = -math.inf
        self._remaining = _frames(self._container, self._stream, self._errors)

    def _decode_up_to(self, time: int) -> None:
        for frame in self._remaining:
            if frame is None or frame.is_corrupt:
                self._failed = True
            if frame is None or frame.pts is None:
                continue
            if not frame.is_corrupt:
                self._whole.add(frame.pts)
            self._reached = max(self._reached, frame.pts)
            self._buffer[frame.pts] = frame
            if len(self._buffer) > _BUFFERED:
                del self._buffer[min(self._buffer)]
            if frame.pts >= time:
                return


def _frames(container: Any, stream: Any, errors: type[Exception]) -> Iterator[Any]:
    """The frames from where a container is, ``None`` for a packet that is damaged; no method, which
    would keep the video in a cycle."""
    with suppress(errors):
        for packet in container.demux(stream):
            try:
                frames = [None] if packet.is_corrupt else packet.decode()
            except errors:
                frames = [None]
            yield from frames


@lru_cache(maxsize=4)
def _open(path: Path, state: str) -> _Video:
    """A video, opened again when the state of the file changes."""
    del state
    return _Video(path)
