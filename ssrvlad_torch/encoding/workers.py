"""Work on many items in worker processes: in order, and never many of them in memory."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from torch.utils.data import DataLoader, Dataset

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 4
"""Items that wait for a worker or have been worked on, for each worker."""


def in_order(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    workers: int,
    begin: Callable[[], None] | None = None,
) -> Iterator[Result]:
    """What work makes of items, in their order.

    The workers are forked, so ``work`` need not be picklable, but items and results must be.
    They compute with one thread each, as a data loader's do. Items are taken from their iterable
    here, while the workers are busy with earlier ones; where that raises, the error comes after
    the results of all items before it. Workers pass over Ctrl-C: whoever consumes
    the results decides what becomes of it. They end with this process, however that ends.

    Args:
        work: what is done with an item.
        items: taken one by one, some ahead of what is worked on.
        workers: number of processes; with 0 or 1 the work is done here.
        begin: called first in each worker.

    Raises:
        ChildProcessError: a worker was killed.
    """
    if workers <= 1:
        yield from map(work, items)
        return

    def begin_worker(_number: int) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if begin:
            begin()

    errors: list[BaseException] = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "This DataLoader will create", UserWarning)
        loader = DataLoader(
            _Work(work),
            batch_size=None,
            sampler=_until_error(items, errors),
            num_workers=workers,
            prefetch_factor=_AHEAD,
            collate_fn=_as_it_is,
            worker_init_fn=begin_worker,
            multiprocessing_context="fork",
        )
        results = iter(loader)
    yield from _until_killed(results)
    for cause in errors:
        raise cause


def _until_killed(results: Iterator[Result]) -> Iterator[Result]:
    """Results of workers, and what became of these in plain words."""
    try:
        yield from results
    except RuntimeError as error:
        if "exited unexpectedly" not in str(error):
            raise
        raise ChildProcessError(
            "a worker process was killed, perhaps because memory ran out; run again to go on"
        ) from error


class _Work(Dataset[Any]):
    """A data set whose index is an item and whose entry is what the work makes of it."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self.work = work

    def __getitem__(self, item: Any) -> Any:
        return self.work(item)


def _until_error(items: Iterable[Item], errors: list[BaseException]) -> Iterator[Item]:
    """Items up to the first that cannot be had; why goes to the errors."""
    try:
        yield from items
    except GeneratorExit:
        raise
    except BaseException as error:
        errors.append(error)


def _as_it_is(result: Result) -> Result:
    return result
