"""Reading in order: items that can be read in no other, and work on many by several threads."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Generic, TypeVar

_BUFFERED = 16
"""Items in memory: threads ask for neighbours in another order."""

Item = TypeVar("Item")
Result = TypeVar("Result")


class ForwardReader(Generic[Item]):
    """Items with rising numbers, which ``read`` gives with their numbers from one at or before a
    number, or from the first. The last stay in memory; for an earlier one it begins again."""

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


def in_order(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    ahead: int,
    start: Callable[[], object] | None = None,
) -> Iterator[Result]:
    """The results of ``work`` on items, in their order, by several threads, at most ``ahead`` at
    once; ``start`` is called in each. An error of the items comes after the results before it."""
    pending: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(max(1, threads), "", start) as pool:
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                while len(pending) >= ahead or (pending and pending[0].done()):
                    yield pending.popleft().result()
        except GeneratorExit:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        except BaseException:
            while pending:
                yield pending.popleft().result()
            raise
        while pending:
            yield pending.popleft().result()
