"""The packets of a video file: the same ones, however often and in whatever order they are read.

Needs the extra ``video``.
"""

import math
import zlib
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from ..files import check_pixels, one_line, requiring

_FORMATS = "mov,matroska,avi,mpegts"
"""No format that names other files, as playlists do."""


class Packet(NamedTuple):
    """What is known of one packet without decoding it.

    Attributes:
        time: when its frame is shown, in units of the stream; ``None`` if it is not shown.
        decoded: when it is decoded, in the same units, or ``None``.
        is_key: whether decoding can begin with it.
        is_corrupt: whether the container says that it is damaged.
        mark: place in the file, size and checksum.
    """

    time: int | None
    decoded: int | None
    is_key: bool
    is_corrupt: bool
    mark: tuple[int | None, int, int]


class VideoPackets:
    """The packets of the first video stream of a file, numbered in the order of the file, which is
    that of decoding. One generator of `decoded` at a time may be in use.

    Attributes:
        packets: all of them.
        unit: seconds in a unit of their times.
        created: time of the first frame in seconds since 1970, or 0 if the file does not say it.
        duration: how long the header says that the stream is, in units; 0 if it does not say.
        lacks_times: whether times are in the order of decoding although frames are shown in
            another, as those of H.264 in AVI, which has no times of presentation.
    """

    def __init__(self, path: Path) -> None:
        with requiring("video", f"{path} needs"):
            import av
        self._path, self._errors = path, av.error.FFmpegError
        try:
            self._container, self._stream = self._open()
            check_pixels(self._stream.height, self._stream.width)
        except Exception as error:  # damaged files raise any exception
            raise ValueError(f"{path} is not a readable video: {one_line(error)}") from error
        self.unit = Fraction(self._stream.time_base or 0)
        self.packets = list(self._scan())
        times = [packet.time for packet in self.packets if packet.time is not None]
        if not times or not self.unit:
            raise ValueError(f"{path} holds no frames with presentation times")
        self._next, self._rest = len(self.packets), iter(())
        is_avi = self._container.format.name == "avi"
        context = self._stream.codec_context
        self.lacks_times = is_avi and context.has_b_frames and times == sorted(times)
        self.duration = self._duration()
        self.created = 0.0
        with suppress(KeyError, ValueError):
            created = datetime.fromisoformat(self._container.metadata["creation_time"])
            self.created = created.timestamp()

    def decoded(self, first: int, stop: int) -> Iterator[tuple[int, Any]]:
        """The frames of the packets from number ``first`` up to ``stop``, each with the number of
        its packet, in the order in which the decoder gives them; ``None`` for a packet that is
        damaged. The decoder has seen no packet before."""
        context = self._decoder()
        for number, packet in self._read(first, stop):
            try:
                damaged = packet is not None and self.packets[number].is_corrupt
                frames = [None] if damaged else context.decode(packet)
            except self._errors:
                frames = [None]
            for frame in frames:
                yield (number if frame is None or frame.pts is None else frame.pts), frame

    def _open(self) -> tuple[Any, Any]:
        import av

        options = {"format_whitelist": _FORMATS}
        container = av.open(str(self._path), options=options, metadata_errors="replace")
        if not container.streams.video:
            raise ValueError("it has no stream of pictures")
        return container, container.streams.video[0]

    def _decoder(self) -> Any:
        """A new decoder: a flushed one would keep the parameters of earlier packets. It has one
        thread: with several, the damage that it reports would depend on their timing."""
        context = self._open()[1].codec_context
        context.thread_type = "NONE"
        context.options = {"err_detect": "explode"}
        return context

    def _scan(self) -> Iterator[Packet]:
        seen = set[int]()
        with suppress(self._errors):  # a truncated file ends here
            for packet in self._demuxed():
                is_shown = not (packet.pts is None or packet.is_discard or packet.pts in seen)
                seen.add(packet.pts)
                yield Packet(
                    packet.pts if is_shown else None,
                    packet.dts,
                    packet.is_keyframe,
                    packet.is_corrupt,
                    _mark(packet),
                )

    def _duration(self) -> int:
        if self._container.format.name == "mpegts":
            return 0  # what is given is a guess from the last time in the file
        if self._stream.duration:
            return int(self._stream.duration)
        hours, _, rest = self._stream.metadata.get("DURATION", "").partition(":")  # Matroska
        minutes, _, seconds = rest.partition(":")
        try:
            total = 3600 * int(hours) + 60 * int(minutes) + float(seconds)
        except ValueError:
            return 0
        return round(total / self.unit) if math.isfinite(total) else 0

    def _read(self, first: int, stop: int) -> Iterator[tuple[int, Any]]:
        """Packets with their numbers, which are also their times; after them ``None``, which
        flushes a decoder."""
        if first != self._next:
            self._seek(first)
        for number in range(first, stop):
            packet = self._following()
            if packet is None or _mark(packet) != self.packets[number].mark:
                self._rewind(number)
                packet = self._following()
            if packet is None or _mark(packet) != self.packets[number].mark:
                raise ValueError("the video changed while it was read")
            self._next = number + 1
            packet.pts = packet.dts = number
            yield number, packet
        yield stop, None

    def _following(self) -> Any:
        with suppress(self._errors):
            return next(self._rest, None)
        return None

    def _seek(self, number: int) -> None:
        """Goes to a packet: to its time, where other packets may come first, or, where that leads
        elsewhere, as in damaged files, from the start of the file."""
        wanted = self.packets[number]
        for time in (wanted.time, wanted.decoded):
            if time is None:
                continue
            with suppress(self._errors):
                self._container.seek(time, stream=self._stream)
                rest = self._demuxed()
                for packet in rest:
                    if _mark(packet) == wanted.mark:
                        self._next, self._rest = number, chain([packet], rest)
                        return
                    if (packet.pos or 0) > (wanted.mark[0] or math.inf):
                        break
        self._rewind(number)

    def _rewind(self, number: int) -> None:
        """Goes to a packet through all that are before it."""
        self._container, self._stream = self._open()
        self._rest = self._demuxed()
        for _ in range(number):
            self._following()
        self._next = number

    def _demuxed(self) -> Iterator[Any]:
        return (packet for packet in self._container.demux(self._stream) if packet.size)


def _mark(packet: Any) -> tuple[int | None, int, int]:
    return packet.pos, packet.size, zlib.crc32(packet)
