"""Frames of video files, by their presentation times. Needs the extra ``video``."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from fractions import Fraction
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..files import check_pixels, npy_bytes, one_line, requiring
from .frame_file import FrameFile
from .names import VIDEO_SUFFIXES, absolute
from .reading import ForwardReader

_FORMATS = "mov,matroska,avi,mpegts"
"""No format that names other files, as playlists do."""
_MISSING_SECONDS = 1.0
"""Between the last frame and the end that the file states, from which on it is noted."""


def _picture(file: FrameFile) -> bytes:
    assert file.row is not None
    return npy_bytes(_open(file.path, file.state).pixels(file.row))


def is_video(path: Path) -> bool:
    """Whether the name of a file is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def video_files(path: Path, note: Callable[[str], object] = lambda _: None) -> list[FrameFile]:
    """The frames of a video in order of presentation, without the name of a sequence. A frame is
    named by its time after the first in microseconds; its stamp is that in seconds, after the
    file's creation time if known. ``note`` gets a file that ends too early. Nothing is decoded. A
    file that cannot be read is a ValueError; no extra ``video`` is an ImportError."""
    folder, video = absolute(path), _open(path, FrameFile("", "", path).state)
    files, last = list[FrameFile](), float(video.times[-1] * video.unit)
    if video.end - last > _MISSING_SECONDS:
        ends = f"lasts {video.end:.1f} s, and its last frame is at {last:.1f} s"
        note(f"{path} {ends}: its end may be missing")
    for time in video.times:
        seconds = (time - video.times[0]) * video.unit
        name, place = f"{round(seconds * 10**6):010d}", f"{path} at {float(seconds):.6f} s"
        file = FrameFile("", name, path, time, folder=folder, place=place, content=_picture)
        files.append(replace(file, stamp=video.created + float(seconds)))
    return files


class _Video:
    """The frames of the first video stream of a file, decoded in order.

    Attributes:
        times: presentation times of all frames, increasing, in units of ``unit`` seconds.
        end: seconds at which the file says that it ends, or 0.
        created: time of the first frame in seconds since 1970, or 0 if the file does not say it.
    """

    def __init__(self, path: Path) -> None:
        with requiring("video", f"{path} needs"):
            import av
        self._path, self._error = path, av.error.FFmpegError
        # a title that is not UTF-8 is no damage; PyAV 19 says so itself
        is_strict = int(av.__version__.partition(".")[0]) < 19
        self._settings: dict[str, Any] = {"metadata_errors": "replace"} if is_strict else {}
        try:
            container, stream = self._opened()
            check_pixels(stream.height, stream.width)
            self.unit = Fraction(stream.time_base or 0)
            packets = (packet for packet in container.demux(stream) if packet.size)
            self.times = sorted({p.pts for p in packets if not (p.pts is None or p.is_discard)})
        except Exception as error:  # damaged files raise any exception
            raise ValueError(f"{path} is not a readable video: {one_line(error)}") from error
        if not self.times or not self.unit:
            raise ValueError(f"{path} holds no frames with presentation times")
        # AVI has the order of decoding alone: where pictures are shown in another, they are counted
        self._counts = container.format.name == "avi" and stream.codec_context.has_b_frames
        self.end, self.created = (container.duration or 0) / 1e6, 0.0
        with suppress(KeyError, ValueError):
            created = datetime.fromisoformat(container.metadata["creation_time"])
            self.created = created.timestamp()
        self._frames = ForwardReader(self._decoded)

    def pixels(self, time: int) -> npt.NDArray[np.uint8]:
        """``(H, W, 3)`` uint8 of the frame at a time, upright; a ValueError if it is damaged."""
        frame = self._frames.item(time)
        if frame is None:
            raise ValueError("the frame does not decode: the video is damaged")
        check_pixels(frame.height, frame.width)
        return _upright(frame)

    def _decoded(self, start: int | None) -> Iterator[tuple[float, Any]]:
        """Times and frames, from the key frame before a time or from the first. A decoder conceals
        damage, and frames that depend on a concealed one decode without an error: all that come
        after damage are left out up to the next key frame."""
        container, stream = self._opened()
        if start is not None and not self._counts:
            container.seek(start, stream=stream)
        context = stream.codec_context
        context.thread_type = "NONE"  # else the damage that it reports depends on their timing
        context.options = {"err_detect": "explode"}
        keys, damaged, times = list[int](), {0}, iter(self.times)  # 0: before the first key frame
        for packet in chain((p for p in container.demux(stream) if p.size), [None]):
            if packet and packet.is_keyframe:
                keys.append(packet.pts)
            try:
                frames = context.decode(packet)
            except self._error:
                frames = []
                damaged.add(len(keys))
            if packet and packet.is_corrupt:
                damaged.add(len(keys))
            for frame in frames:
                group = len(keys) if self._counts else bisect_right(keys, frame.pts)
                if frame.is_corrupt:
                    damaged.add(group)
                if self._counts and len(damaged) > 1:
                    return
                if group not in damaged:
                    yield (next(times, math.inf) if self._counts else frame.pts), frame

    def _opened(self) -> tuple[Any, Any]:
        import av

        settings = {"options": {"format_whitelist": _FORMATS}, **self._settings}
        container = av.open(str(self._path), **settings)
        if not container.streams.video:
            raise ValueError("it has no stream of pictures")
        return container, container.streams.video[0]


def _upright(frame: Any) -> npt.NDArray[np.uint8]:
    """The pixels of a frame as its display matrix shows them: turned, mirrored, or both."""
    pixels = frame.to_ndarray(format="rgb24")
    if matrix := frame.side_data.get("DISPLAYMATRIX"):
        right_x, right_y, _, down_x, down_y, *_ = np.frombuffer(matrix, np.int32).tolist()
        x, y = right_x, down_y  # where a step to the right and one down lead
        if abs(right_y) > abs(right_x):
            pixels, x, y = pixels.transpose(1, 0, 2), down_x, right_y
        pixels = pixels[:: -1 if y < 0 else 1, :: -1 if x < 0 else 1]
    return np.ascontiguousarray(pixels)


@lru_cache(maxsize=4)
def _open(path: Path, _state: str) -> _Video:
    """A video, opened again when the state of the file changes."""
    return _Video(path)
