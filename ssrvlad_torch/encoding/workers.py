"""Work on many items by several workers: in order, and never many of them in memory.

A worker is a thread of this process, or a process of its own: this Python run anew, with a pipe for
each direction. That reads pickled items from the one and writes pickled results to the other.
Nothing is forked, so it does not matter what threads run here, and it is the same on every system.
When this process ends, however it ends, its ends of the pipes close, and the worker reads the end
of its file and ends too.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import IO, Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 2
"""Items that wait for a worker or are worked on, for each worker."""


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, processes: int = 0
) -> Iterator[Result]:
    """The results of work on items, in their order.

    Items are taken from their iterable here, while the workers are busy with earlier ones. Where
    that raises, the error comes after the results of all items before it. Workers ignore Ctrl-C:
    the consumer of the results handles it.

    Args:
        work: is done with an item. For processes it, the items and the results must be picklable;
            for several threads it must be safe to call at once.
        items: taken one by one, some ahead of what is worked on.
        threads, processes: number of workers of each kind, each with one thread of torch. Without
            processes and at most one thread the work is done in the caller's.

    Raises:
        ChildProcessError: a worker was killed.
    """
    workers = threads + processes
    if not processes and threads <= 1:
        yield from map(work, items)
        return
    import torch

    with ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())  # of threads to come
        pool = stack.enter_context(ThreadPoolExecutor(workers, "", torch.set_num_threads, (1,)))
        idle: queue.SimpleQueue[Callable[[Item], Result]] = queue.SimpleQueue()
        for _ in range(threads):
            idle.put(work)
        for _ in range(processes):
            worker = _Worker(work)
            stack.callback(worker.end)
            idle.put(worker)
        stack.callback(pool.shutdown, wait=False, cancel_futures=True)

        def run(item: Item) -> Result:
            worker = idle.get()
            try:
                result: Result = worker(item)
            finally:
                idle.put(worker)
            return result

        pending: deque[Future[Result]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(run, item))
                while len(pending) > _AHEAD * workers or (pending and pending[0].done()):
                    yield pending.popleft().result()
        except GeneratorExit:
            raise
        except BaseException:
            while pending:
                yield pending.popleft().result()
            raise
        while pending:
            yield pending.popleft().result()


class _Worker:
    """A process that does one kind of work."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        program = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as w; w.serve()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C in a terminal is for the parent
        )
        self._send = _put_in(self._process.stdin)
        self._send(work)

    def __call__(self, item: Any) -> Any:
        try:
            self._send(item)
            assert self._process.stdout
            succeeded, result = pickle.load(self._process.stdout)
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
            raise ChildProcessError(
                "a worker process was killed, perhaps because memory ran out; run again to go on"
            ) from error
        if not succeeded:
            raise result
        return result

    def end(self) -> None:
        """Ends the process; its current work is lost."""
        self._process.kill()
        self._process.communicate()


def serve() -> None:
    """A worker's life: work from standard input, then items, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    source, send = sys.stdin.buffer, _put_in(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # what libraries print must not come between the results
    try:
        work = pickle.load(source)
        while True:
            item = pickle.load(source)
            try:
                answer = True, work(item)
            except Exception as error:
                answer = False, error
            send(answer)
    except (EOFError, BrokenPipeError):
        os._exit(0)


def _put_in(stream: IO[bytes] | None) -> Callable[[Any], None]:
    assert stream

    def put(value: Any) -> None:
        stream.write(pickle.dumps(value, pickle.HIGHEST_PROTOCOL))
        stream.flush()

    return put
