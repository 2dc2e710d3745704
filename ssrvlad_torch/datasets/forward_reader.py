"""Items that can only be read in order, asked for in any."""

import math
from collections.abc import Callable, Iterator
from threading import Lock
from typing import Generic, TypeVar

_BUFFERED = 16
"""Items in memory: threads ask for neighbours in another order."""

Item = TypeVar("Item")


class ForwardReader(Generic[Item]):
    """Items with rising numbers. The last ones stay in memory; for one before them, reading begins
    again.

    Args:
        read: gives items with their numbers, from one at or before a number, or from the first for
            ``None``.
    """

    def __init__(self, read: Callable[[int | None], Iterator[tuple[float, Item]]]) -> None:
        self._read, self._lock = read, Lock()
        self._begin(None)

    def item(self, number: int) -> Item | None:
        """The item of a number; ``None`` if none has it."""
        with self._lock:
            if number not in self._buffer and number <= self._reached:
                self._begin(number)
            self._advance(number)
            if number not in self._buffer and self._start is not None:  # it began too late
                self._begin(None)
                self._advance(number)
            return self._buffer.get(number)

    def _begin(self, start: int | None) -> None:
        self._start, self._items, self._reached = start, self._read(start), -math.inf
        self._buffer = dict[float, Item]()

    def _advance(self, number: int) -> None:
        while self._reached < number:
            try:
                self._reached, item = next(self._items)
            except StopIteration:
                self._reached = math.inf
                return
            self._buffer[self._reached] = item
            if len(self._buffer) > _BUFFERED:
                del self._buffer[next(iter(self._buffer))]
