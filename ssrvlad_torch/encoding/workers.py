"""Work on many items by several workers: results in order, with few items in memory.

A worker is a thread of this process, or another process. A worker process is a new Python that
reads pickled items from one pipe and writes pickled results to another. It is not forked: threads
of this process do no harm, and all systems behave alike. When this process ends for any reason, its
pipes close, and so the worker processes end.
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
"""Items taken in advance for each worker."""


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], threads: int, processes: int = 0
) -> Iterator[Result]:
    """The results of ``work`` on items, in their order.

    Items are taken in the caller's thread while the workers are busy with earlier ones. If that
    raises an error, it comes after the results of all earlier items. Worker processes ignore
    Ctrl-C: the consumer of the results handles it.

    Args:
        work: called with each item. For processes, it, the items and the results must be picklable;
            for several threads, it must be thread-safe.
        items: taken one by one, a few in advance.
        threads, processes: number of workers of each kind, each with one thread of torch. With at
            most one thread and no process, the work is done in the caller's thread.

    Raises:
        ChildProcessError: a worker was killed.
    """
    workers = threads + processes
    if not processes and threads <= 1:
        yield from map(work, items)
        return
    import torch

    with ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())  # for later threads
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
    """A process that applies one function to items."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        program = f"import sys; sys.path[:] = {sys.path!r}; import {__name__} as w; w.serve()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C in a terminal reaches only the parent
        )
        self._send = _sender(self._process.stdin)
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
        """Ends the process and discards its current work."""
        self._process.kill()
        self._process.communicate()


def serve() -> None:
    """The main function of a worker process: reads the work, then items, from standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    source, send = sys.stdin.buffer, _sender(os.fdopen(os.dup(1), "wb"))
    os.dup2(2, 1)  # output of libraries must not mix with the results
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


def _sender(stream: IO[bytes] | None) -> Callable[[Any], None]:
    """A function that pickles a value to a stream."""
    assert stream

    def send(value: Any) -> None:
        stream.write(pickle.dumps(value, pickle.HIGHEST_PROTOCOL))
        stream.flush()

    return send
