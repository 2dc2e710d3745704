"""Work on many items by several threads: results in order, with few items in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    ahead: int,
    start: Callable[[], object] | None = None,
) -> Iterator[Result]:
    """The results of ``work`` on items, in their order.

    Items are taken in the caller's thread while the workers are busy with earlier ones. If that
    raises an error, it comes after the results of all earlier items.

    Args:
        work: called with each item; must be thread-safe for several threads.
        items: taken one by one, at most ``ahead`` of them before the first has a result.
        threads: number of workers.
        ahead: number of items in memory.
        start: called once in each worker.
    """
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
