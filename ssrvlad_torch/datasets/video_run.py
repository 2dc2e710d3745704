"""One run of a decoder through the packets of a video."""

import math
from collections.abc import Mapping
from typing import Any

from .video_packets import VideoPackets

_BUFFERED = 16


class DecodingRun:
    """The frames of the packets from number ``start`` up to ``stop``, decoded as far as was asked.
    The last `_BUFFERED` of them stay in memory.

    A decoder conceals damage, and frames that depend on a concealed one decode without an error:
    with a damaged packet, all later ones fail.

    Args:
        source: gives the packets.
        ranks: the place of the packets' frames in the order of showing.
        start, stop: numbers of packets.
        failed: gets the first packet that is known to be damaged, by start and stop.
    """

    def __init__(
        self,
        source: VideoPackets,
        ranks: Mapping[int, int],
        start: int,
        stop: int,
        failed: dict[tuple[int, int], int],
    ) -> None:
        self.ends, self._failed = (start, stop), failed
        self._ranks, self._outputs = ranks, source.decoded(start, stop)
        self._buffer, self._last = dict[int, Any](), list[int]()
        self._reached, self._is_opened = -1, False

    def opens(self) -> bool:
        """Whether the first packet gives a frame, or is damaged."""
        return (
            self.frame(self.ends[0]) is not None
            or self._is_opened
            or not self._is_whole(self.ends[0])
        )

    def has_passed(self, number: int) -> bool:
        """Whether the frame of a packet is not in memory and will not come."""
        rank = self._ranks[number]
        return rank <= self._reached and rank not in self._buffer

    def frame(self, number: int) -> Any:
        """The frame of a packet; ``None`` if it or one before it is damaged, or it has none."""
        while self._reached < self._last_up_to(number) and self._is_whole(number):
            output = next(self._outputs, None)
            if output is None:
                break
            self._take(*output)
        return self._buffer.get(self._ranks[number]) if self._is_whole(number) else None

    def _is_whole(self, number: int) -> bool:
        return number < self._failed.get(self.ends, math.inf)

    def _last_up_to(self, number: int) -> int:
        """The highest rank of the packets up to a number."""
        for following in range(self.ends[0] + len(self._last), number + 1):
            self._last.append(max(*self._last[-1:], self._ranks.get(following, 0), 0))
        return self._last[number - self.ends[0]]

    def _take(self, number: int, frame: Any) -> None:
        rank, start = self._ranks.get(number, math.inf), self.ends[0]
        if rank < self._ranks.get(start, 0):
            return  # shown before the first, it may depend on what was not decoded
        if frame is None or frame.is_corrupt:
            self._failed[self.ends] = min(self._failed.get(self.ends, number), number)
        if frame is None or math.isinf(rank):
            return
        self._is_opened |= number == start
        self._reached = max(self._reached, int(rank))
        self._buffer[int(rank)] = frame
        if len(self._buffer) > _BUFFERED:
            del self._buffer[min(self._buffer)]
