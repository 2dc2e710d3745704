"""Work on many items by several threads: results in order, with few items in memory."""

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
    """The results of ``work``, which several threads call, on items, in their order. ``start`` is
    called once in each worker.

    Items are taken one by one in the caller's thread while the workers are busy with earlier ones,
    at most ``ahead`` of them before the first has a result. If taking one raises an error, it comes
    after the results of all earlier items.
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
