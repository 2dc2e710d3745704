"""The packets of a video file: the same ones, however often and in whatever order they are read.

Needs the extra ``video``.
"""

import math
import zlib
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from fractions import Fraction
from itertools import islice
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
    that of decoding.

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
        self._next, self._rest = len(self.packets), self._demuxed()
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
        context = self._open()[1].codec_context
        context.thread_type = "NONE"  # else the damage that it reports depends on their timing
        context.options = {"err_detect": "explode"}
        for number in range(first, stop + 1):
            packet = self._packet(number) if number < stop else None  # this flushes the decoder
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

    def _scan(self) -> Iterator[Packet]:
        seen = set[int]()
        with suppress(self._errors):  # a truncated file ends here
            for packet in self._demuxed():
                is_shown = not (packet.pts is None or packet.is_discard or packet.pts in seen)
                seen.add(packet.pts)
                time = packet.pts if is_shown else None
                flags = packet.is_keyframe, packet.is_corrupt
                yield Packet(time, packet.dts, *flags, _mark(packet))

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

    def _packet(self, number: int) -> Any:
        """A packet by its number, which is also its time."""
        wanted = self.packets[number].mark
        for packets in self._ways_to(number):
            with suppress(self._errors):
                for packet in packets:
                    if _mark(packet) == wanted:
                        self._next, self._rest = number + 1, packets
                        packet.pts = packet.dts = number
                        return packet
                    if (packet.pos or 0) > (wanted[0] or math.inf):
                        break
        raise ValueError("the video changed while it was read")

    def _ways_to(self, number: int) -> Iterator[Iterator[Any]]:
        """Packets among which one may be: those after the last one, those at its time, or, where
        that leads elsewhere, as in damaged files, those of the whole file."""
        if number == self._next:
            yield self._rest
        for time in (self.packets[number].time, self.packets[number].decoded):
            if time is not None:
                with suppress(self._errors):
                    self._container.seek(time, stream=self._stream)
                    yield self._demuxed()
        self._container, self._stream = self._open()
        yield islice(self._demuxed(), number, None)

    def _demuxed(self) -> Iterator[Any]:
        return (packet for packet in self._container.demux(self._stream) if packet.size)


def _mark(packet: Any) -> tuple[int | None, int, int]:
    return packet.pos, packet.size, zlib.crc32(packet)
